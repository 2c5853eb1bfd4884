"""The content of the report, as JSON for the page's script."""

from __future__ import annotations

import base64
import hashlib
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.results.render import axis_of
from nsm.results.report.curves import read_curves
from nsm.results.report.labels import differing, labels, over_seeds, shown
from nsm.results.report.pictures import UNREADABLE, read_picture, read_pictures
from nsm.results.report.runs import Incomplete, Run, short
from nsm.results.report.shapes import Distortion, Shape, read_shapes
from nsm.results.report.sweep import FIGURE
from nsm.results.tables import FIGURES

_BINS = 60
_TALLEST = 8000  # pixels of the figure of a sweep
_HISTOGRAMS = ("symmetric dirichlet", "singular value ratio", "area")
_BEST = {
    "covered_percent": "high",
    "normal_variation_excess_degrees": "zero",
    "steps": "none",
    "certified": "none",
    "landmark_correlation": "none",
    "landmarks_doubtful": "none",
    "landmarks_sure": "none",
}  # of the figures for which it is not the lowest value


class _Arrays:
    """The arrays of the page; shapes that use the same array share it."""

    def __init__(self) -> None:
        self.stored: list[dict[str, str]] = []
        self._known: dict[bytes, int] = {}

    def add(self, array: np.ndarray) -> int:
        if np.issubdtype(array.dtype, np.integer):
            small = array.size == 0 or int(array.max()) < 2**16
            packed, kind = array.astype("<u2" if small else "<u4"), "u2" if small else "u4"
        else:
            packed, kind = array.astype("<f4"), "f4"
        data = np.ascontiguousarray(packed).tobytes()
        key = hashlib.sha256(kind.encode() + data).digest()
        if key not in self._known:
            self._known[key] = len(self.stored)
            self.stored.append({"type": kind, "data": base64.b64encode(data).decode()})
        return self._known[key]


def content(
    title: str,
    runs: Sequence[Run],
    incomplete: Sequence[Incomplete],
    trust: Sequence[str] = (),
    up: str | None = None,
) -> dict[str, Any]:
    """Everything on the page. Files that cannot be read are listed with the incomplete runs."""
    arrays = _Arrays()
    remarks = [{"name": item.name, "reason": item.reason} for item in incomplete]
    tasks = []
    for task in sorted({run.task for run in runs}):
        of_task = [run for run in runs if run.task == task]
        tasks.append(_task(task, of_task, arrays, remarks, trust))
    return {
        "title": title,
        "up": up or Counter(axis_of(run.settings) for run in runs).most_common(1)[0][0],
        "sweeps": _sweeps(runs, remarks),
        "tasks": tasks,
        "incomplete": remarks,
        "arrays": arrays.stored,
    }


def _sweeps(runs: Sequence[Run], remarks: list[dict[str, str]]) -> list[dict[str, str]]:
    """The figures that sweeps left; adds remarks on those that cannot be read."""
    pictures = []
    for folder in dict.fromkeys(run.folder.resolve().parent for run in runs):
        if (folder / FIGURE).is_file():
            try:
                picture = read_picture(folder / FIGURE, _TALLEST)
                pictures.append({"name": folder.name, "picture": picture})
            except UNREADABLE as error:
                remarks.append({"name": folder.name, "reason": f"{FIGURE}: {short(error)}"})
    return pictures


def _task(
    task: str,
    runs: Sequence[Run],
    arrays: _Arrays,
    remarks: list[dict[str, str]],
    trust: Sequence[str],
) -> dict[str, Any]:
    """The runs of one task; adds remarks on files that cannot be read."""
    entries = []
    distortions: list[Distortion | None] = []
    for run, label in zip(runs, labels(runs), strict=True):
        curves, of_curves = read_curves(run.folder)
        pictures, of_pictures = read_pictures(run.folder)
        reasons = [*of_curves, *of_pictures]
        shapes: list[Shape] = []
        distortion = None
        try:
            shapes, distortion = read_shapes(task, run.folder, trust)
        except NsmError as error:
            reasons.append(f"no 3D view and no histogram: {error}")
        distortions.append(distortion)
        remarks += [{"name": run.name, "reason": reason} for reason in reasons]
        entries.append(
            {
                "name": run.name,
                "label": label,
                "settings": {key: shown(value) for key, value in run.settings.items()},
                "figures": run.figures,
                "warnings": run.warnings,
                "curves": {tag: curve._asdict() for tag, curve in curves.items()},
                "pictures": pictures,
                "shapes": [_packed(shape, arrays) for shape in shapes],
            }
        )
    return {
        "name": task,
        "differing": differing(runs),
        "figures": _described({key for run in runs for key in run.figures}),
        "histograms": _histograms(distortions),
        "runs": entries,
        "seeds": [group._asdict() for group in over_seeds(runs)],
    }


def _described(keys: set[str]) -> list[dict[str, Any]]:
    """The figures in the order of the tables; those without a label come last and are hidden."""
    order = {key: n for n, key in enumerate(FIGURES)}
    result = []
    for key in sorted(keys, key=lambda k: (order.get(k, len(order)), k)):
        label, unit = FIGURES.get(key, (key.replace("_", " "), ""))
        main = key in FIGURES
        best = _BEST.get(key, "low" if main else "none")
        result.append({"key": key, "label": label, "unit": unit, "best": best, "main": main})
    return result


def _histograms(distortions: Sequence[Distortion | None]) -> list[dict[str, Any]]:
    """For each energy the edges of bins, the same for all runs, and each run's share of area."""
    known = [distortion for distortion in distortions if distortion is not None]
    result: list[dict[str, Any]] = []
    for energy in _HISTOGRAMS:
        pooled = np.concatenate([d.values[energy] for d in known]) if known else np.zeros(0)
        pooled = pooled[np.isfinite(pooled) & (pooled > 0)]
        if not len(pooled):
            continue
        low, high = np.percentile(pooled, [0.5, 99.5])
        edges = np.geomspace(low, max(high, 1.001 * low), _BINS + 1)
        shares = [None if d is None else _shares(d, energy, edges) for d in distortions]
        result.append({"name": energy, "edges": _rounded(edges), "shares": shares})
    return result


def _shares(distortion: Distortion, energy: str, edges: np.ndarray) -> list[float]:
    """Percent of the source's area in each bin; values beyond the ends count in the last bins."""
    values = np.nan_to_num(distortion.values[energy], nan=np.inf)
    inside = np.clip(values, edges[0], edges[-1])
    counts = np.histogram(inside, bins=edges, weights=distortion.areas)[0]
    return _rounded(100 * counts / distortion.areas.sum())


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{value:.5g}") for value in values]


def _packed(shape: Shape, arrays: _Arrays) -> dict[str, Any]:
    colours = {}
    for name, values in shape.colours.items():
        finite = np.where(np.isfinite(values), values, np.nan)
        known = values[np.isfinite(values)]
        colours[name] = {
            "values": arrays.add(finite),
            "of": "faces" if len(values) == len(shape.faces) else "vertices",
            "range": _rounded(np.percentile(known, [1, 98]) if len(known) else np.zeros(2)),
        }
    return {
        "name": shape.name,
        "vertices": arrays.add(shape.vertices),
        "faces": arrays.add(shape.faces),
        "colours": colours,
        "frames": {
            axis: {"up": _rounded(frame[1]), "towards": _rounded(frame[2])}
            for axis, frame in shape.frames.items()
        },
    }
