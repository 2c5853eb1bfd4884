"""The figure and the table at the end of a sweep: a row a job, as in the paper's ablation."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.table import Column, Table

from nsm.energies.distortion import LEAST_SYMMETRIC_DIRICHLET
from nsm.errors import NsmError
from nsm.results.artifact import load_surface
from nsm.results.collection import load_collection
from nsm.results.files import atomic_write
from nsm.results.metrics import evaluate
from nsm.results.pair_pictures import WORST, distorted
from nsm.results.parameterization import load_parameterization
from nsm.results.pictures import checked, fine, layout_image, panels, save_figure
from nsm.results.render import Blend, View, vertex_normals
from nsm.results.report.labels import OverSeeds, labels, over_seeds
from nsm.results.report.runs import Run, find_runs
from nsm.results.stored_map import load_surface_map
from nsm.results.surface_map import SurfaceMap
from nsm.results.tables import FIGURES, narrow
from nsm.results.textures import GREY

FIGURE, TABLE = "sweep.png", "sweep.csv"
_ROWS, _LINES = 24, 40  # at most, in the figure and in what is printed
_SIDE = 420
# of the table that is printed; the file has all figures
_PRINTED = {
    "overfit": ("rms_percent", "normal_error_mean_degrees", "normal_variation_error_degrees"),
    "": (
        "symmetric_dirichlet_median",
        "singular_value_ratio_median",
        "landmark_error_max_percent",
        "seam_gap_mean_percent",
        "flipped_before_repair_percent",
        "flipped_percent",
    ),
}
_Panels = list[tuple[np.ndarray, str]]


def write_sweep(folder: Path, trust: Sequence[str] = (), *, figure: bool = True) -> Table | None:
    """Write ``sweep.csv`` and ``sweep.png`` about the complete jobs of a sweep.

    Args:
        folder: of the sweep.
        figure: whether there is to be a picture.
        trust: modules outside nsm whose code the files of the runs may name.

    Returns:
        The main figures, with the mean and the standard deviation over seeds; None: fewer than two
        jobs are complete.
    """
    runs, _ = find_runs([folder])
    if len(runs) < 2:
        return None
    names = labels(runs)
    _write_table(folder / TABLE, runs, names)
    chosen = list(zip(runs, names, strict=True))[: _ROWS if figure else 0]
    rows = [_row(run, name, trust) for run, name in chosen]
    drawn = [row for row in rows if row is not None]
    if drawn:
        width = max(map(len, drawn))
        nothing = np.ones((_SIDE, _SIDE, 3)), ""
        save_figure(
            panels(*(row + [nothing] * (width - len(row)) for row in drawn)), folder / FIGURE
        )
    return _table(runs, names)


def _write_table(file: Path, runs: Sequence[Run], names: Sequence[str]) -> None:
    """All figures: a row for each job, then the mean and the deviation of those over seeds."""
    keys = list(dict.fromkeys(key for run in runs for key in run.figures))
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["job", "folder", *keys])
    for run, name in zip(runs, names, strict=True):
        writer.writerow([name, run.name, *(run.figures.get(key) for key in keys)])
    for group in over_seeds(runs):
        for which, what in enumerate(("mean", "standard deviation")):
            row = [group.figures[key][which] if key in group.figures else "" for key in keys]
            writer.writerow([f"{group.label}: {what} of {len(group.runs)} seeds", "", *row])
    atomic_write(file, text.getvalue().encode())


def _table(runs: Sequence[Run], names: Sequence[str]) -> Table:
    chosen = [_PRINTED.get(run.task, _PRINTED[""]) for run in runs]
    keys = [k for k in dict.fromkeys(sum(chosen, ())) if any(k in run.figures for run in runs)]
    names, subject = _without_subject(runs, names)
    # names of jobs are not cut short: the ends tell them apart
    table = narrow(Column("job", overflow="fold"), (" ".join(FIGURES[k]).strip() for k in keys))
    table.title = subject
    groups = over_seeds(runs)
    grouped = {number: group for group in groups for number in group.runs}
    for number, (run, name) in list(enumerate(zip(runs, names, strict=True)))[:_LINES]:
        group = grouped.get(number)
        if group is None:
            table.add_row(name, *(_number(run.figures.get(key)) for key in keys))
        elif group.runs[0] == number:
            label = group.label.removeprefix(f"{subject}, ")
            table.add_row(f"{label}, {len(group.runs)} seeds", *_with_deviations(group, keys))
    if len(runs) > _LINES:
        table.caption = f"the first {_LINES} of {len(runs)} jobs; {TABLE} has all"
    return table


def _without_subject(runs: Sequence[Run], names: Sequence[str]) -> tuple[list[str], str | None]:
    """The names without what all runs are of, and that; None: they are not of the same."""
    first = runs[0].subject
    if any(run.subject != first for run in runs):
        return list(names), None
    return [name.removeprefix(f"{first}, ") for name in names], first


def _with_deviations(group: OverSeeds, keys: Sequence[str]) -> list[str]:
    there = [group.figures.get(key) for key in keys]
    return ["–" if pair is None else f"{pair[0]:.3f} ± {pair[1]:.3f}" for pair in there]


def _number(value: float | str | None) -> str:
    return f"{value:.3f}" if isinstance(value, (int, float)) else value or "–"


def _row(run: Run, name: str, trust: Sequence[str]) -> _Panels | None:
    """What a job made, with its name; None if it cannot be drawn."""
    try:
        (first, title), *others = _DRAW[run.task](run.folder, trust)
    except (KeyError, NsmError, ValueError, IndexError, RuntimeError):
        return None  # another task, or a damaged file, which the report names
    return [(first, f"{name}\n{title}"), *others]


def _overfit(folder: Path, trust: Sequence[str]) -> _Panels:
    neural = load_surface(folder, trust=trust)
    surface = neural.surface
    view = View(surface.vertices, _SIDE)
    uv, faces = fine(surface)
    vertices = evaluate(neural.map, uv)
    normals = 0.5 * (vertex_normals(vertices, faces) @ view.frame.T + 1)

    def grey(blend: Blend) -> np.ndarray:
        return GREY

    metrics = neural.metrics
    said = (
        f"RMS {metrics['rms_percent']:.3g} %, normals {metrics['normal_error_mean_degrees']:.3g}°"
    )
    shape = view.seen(vertices, faces)
    return [
        (shape.painted(grey), f"neural surface: {said}"),
        (shape.painted(lambda blend: blend(normals)), "colours of its normals"),
        (view.draw(surface.vertices, surface.faces, grey, surface.seam_pairs), "mesh"),
    ]


def _param(folder: Path, trust: Sequence[str]) -> _Panels:
    result = load_parameterization(folder, trust=trust)
    surface, uv = result.phi.surface, result.uv
    view = View(surface.vertices, _SIDE)
    picture = view.draw(surface.vertices, surface.faces, checked(uv), surface.seam_pairs)
    layout = layout_image(surface, uv, size=_SIDE)
    flat = np.column_stack([uv, np.zeros(len(uv))])
    return [
        (picture, "checkerboard"),
        (layout, "flattened"),
        (distorted(view, surface, flat), _scale(result.metrics["nsm"])),
    ]


def _pair_map(folder: Path, trust: Sequence[str]) -> _Panels:
    return _pair(load_surface_map(folder, trust=trust))


def _collection_map(folder: Path, trust: Sequence[str]) -> _Panels:
    return _pair(load_collection(folder, trust=trust).pair(0, 1))


def _pair(f: SurfaceMap) -> _Panels:
    f = f.part
    source = f.source.surface
    view, image = View(source.vertices, _SIDE), f.aligned_image
    other = View(image, _SIDE, frame=view.frame)
    board, title = checked(source.uv), f"its image on {f.target.surface.name}"
    if "seam_gap_mean_percent" in f.metrics:
        title += f": gap across the seam {f.metrics['seam_gap_mean_percent']:.3g} %"
    return [
        (view.draw(source.vertices, source.faces, board, source.seam_pairs), source.name),
        (other.draw(image, source.faces, board, source.seam_pairs), title),
        (distorted(view, source, f.image), _scale(f.metrics)),
    ]


def _scale(metrics: Mapping[str, float]) -> str:
    """What the colours of the distortion say, and its median."""
    ends = f"{LEAST_SYMMETRIC_DIRICHLET} to {WORST:.0f}"
    return f"symmetric Dirichlet, {ends}: median {metrics['symmetric_dirichlet_median']:.3f}"


_DRAW: dict[str, Callable[[Path, Sequence[str]], _Panels]] = {
    "overfit": _overfit,
    "param": _param,
    "pair_map": _pair_map,
    "collection_map": _collection_map,
}
