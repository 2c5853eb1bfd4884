"""The learning curves of a run, from its TensorBoard event files and CSV logs."""

from __future__ import annotations

import csv
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

from nsm.results.report.runs import short

_POINTS = 500  # at most, per curve: more would only enlarge the page
_NO_CURVES = ("hp_metric", "epoch")
_FINAL = "figures/"  # one value each, at the end: the table has them


class Curve(NamedTuple):
    """A scalar during training: steps, values and, if known, seconds since the first value."""

    steps: list[int]
    values: list[float | None]
    seconds: list[float] | None


def read_curves(folder: Path) -> tuple[dict[str, Curve], list[str]]:
    """The curves of a run folder by their tags, and remarks on damaged files."""
    curves: dict[str, Curve] = {}
    remarks = []
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    for file in sorted(folder.rglob("metrics.csv")):
        try:
            curves.update(_from_csv(file))
        except (OSError, ValueError, csv.Error) as error:
            remarks.append(f"{file.relative_to(folder)}: {short(error)}")
    for place in sorted({file.parent for file in folder.rglob("events.out.tfevents.*")}):
        try:
            curves.update(_from_events(place))
        except Exception as error:  # the reader has no exception class for damaged files
            remarks.append(f"{place.relative_to(folder)}: {short(error)}")
    return {tag: curves[tag] for tag in sorted(curves)}, remarks


def _from_events(place: Path) -> dict[str, Curve]:
    reader = EventAccumulator(str(place), size_guidance={SCALARS: 0})
    reader.Reload()
    curves = {}
    for tag in reader.Tags()[SCALARS]:
        if tag in _NO_CURVES or tag.startswith(_FINAL):
            continue
        # a resumed run repeats the steps after its last checkpoint: keep the later value
        events = {event.step: event for event in reader.Scalars(tag)}
        times = {step: event.wall_time for step, event in events.items()}
        curves[tag] = _curve({step: event.value for step, event in events.items()}, times)
    return curves


def _from_csv(file: Path) -> dict[str, Curve]:
    with file.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    values: dict[str, dict[int, float]] = {}
    for row in rows:
        for tag, text in row.items():
            if tag not in ("step", *_NO_CURVES) and tag and text:
                values.setdefault(tag, {})[int(row["step"])] = float(text)
    return {tag: _curve(by_step) for tag, by_step in values.items()}


def _curve(values: Mapping[int, float], times: Mapping[int, float] | None = None) -> Curve:
    """The curve of values and times by step, thinned but with its last step."""
    steps = sorted(values)
    kept = steps[:: -(-len(steps) // _POINTS)]
    if kept[-1] != steps[-1]:
        kept.append(steps[-1])
    seconds = [round(times[step] - times[kept[0]], 3) for step in kept] if times else None
    return Curve(kept, [_finite(values[step]) for step in kept], seconds)


def _finite(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None
