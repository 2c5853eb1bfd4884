"""What runs are called beside each other: what they are of, and the settings that differ."""

from __future__ import annotations

import json
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from nsm.results.report.runs import Run

_CHOICES = 3  # at most, of the settings that differ, in a label
# what a run is of, which its subject says
_INPUTS = {"surface", "surface.path", "surface.name", "source", "target", "surfaces", "phi.path"}


class OverSeeds(NamedTuple):
    """Runs that differ in nothing but the seed.

    Attributes:
        label: what they are called.
        runs: their numbers.
        figures: of each figure that is a number in all, the mean and the standard deviation.
    """

    label: str
    runs: list[int]
    figures: dict[str, tuple[float, float]]


def differing(runs: Sequence[Run]) -> list[str]:
    """The settings that are not the same in all runs."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)

    def values(key: str) -> set[str]:
        return {f"={shown(run.settings[key])}" if key in run.settings else "" for run in runs}

    return [key for key in keys if len(values(key)) > 1]


def labels(runs: Sequence[Run]) -> list[str]:
    """A short label for each run: its subject and settings that differ, and its path where those
    are not unique."""
    different = differing(runs)
    last = Counter(key.rsplit(".", 1)[-1] for key in different)
    telling = _telling(runs, different)
    result = []
    for run in runs:
        chosen = [key for key in telling if isinstance(run.settings.get(key), (str, int, float))]
        short = {key: key.rsplit(".", 1)[-1] for key in chosen[:_CHOICES]}
        parts = [
            f"{end if last[end] == 1 else key}={_brief(run.settings[key])}"
            for key, end in short.items()
        ]
        result.append(", ".join([run.subject, *parts] if run.subject else parts))
    count = Counter(result)
    return [
        text if text and count[text] == 1 else f"{text} ({run.name})" if text else run.name
        for text, run in zip(result, runs, strict=True)
    ]


def _telling(runs: Sequence[Run], different: Sequence[str]) -> list[str]:
    """The settings that differ, but for what runs are of and for what others say already.

    A group's choice stands for its parameters, or they for it, where the one follows from the
    other; else both are told.
    """
    said: set[str] = set(_INPUTS)
    for group in different:
        inner = [key for key in different if key.startswith(f"{group}.")]
        if not inner:
            continue
        choices = [json.dumps(run.settings.get(group)) for run in runs]
        parameters = [json.dumps([run.settings.get(key) for key in inner]) for run in runs]
        both = len(set(zip(choices, parameters, strict=True)))
        if len(set(choices)) == both:
            said.update(inner)
        elif len(set(parameters)) == both:
            said.add(group)
    return [key for key in different if key not in said]


def over_seeds(runs: Sequence[Run]) -> list[OverSeeds]:
    """The groups of two runs or more that differ in nothing but the seed, in the runs' order."""
    without = [
        replace(run, settings={k: v for k, v in run.settings.items() if k != "seed"})
        for run in runs
    ]
    groups: dict[str, list[int]] = {}
    for number, run in enumerate(without):
        key = json.dumps([run.task, run.subject, run.settings], sort_keys=True, default=str)
        groups.setdefault(key, []).append(number)
    several = [numbers for numbers in groups.values() if len(numbers) > 1]
    # one of each group, so that nothing but the groups has to be told apart
    alone = labels([without[numbers[0]] for numbers in groups.values()])
    named = dict(zip((numbers[0] for numbers in groups.values()), alone, strict=True))
    return [OverSeeds(named[n[0]], n, _statistics([runs[k].figures for k in n])) for n in several]


def _statistics(figures: Sequence[dict[str, Any]]) -> dict[str, tuple[float, float]]:
    result = {}
    for key in figures[0]:
        values = [one.get(key) for one in figures]
        numbers = [v for v in values if isinstance(v, (int, float))]
        if len(numbers) == len(values):
            result[key] = (statistics.fmean(numbers), statistics.stdev(numbers))
    return result


def _brief(value: Any) -> str:
    """A setting in a label: of a path the last part."""
    return str(shown(value)).rsplit("/", 1)[-1][:40]


def shown(value: Any) -> str | float | None:
    """A setting on the page: finite numbers unchanged, everything else as text."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return value if abs(value) < float("inf") else str(value)
    if value is None or isinstance(value, str):
        return value
    return json.dumps(value, ensure_ascii=False, default=str)
