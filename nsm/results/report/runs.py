"""Runs found in folders: their settings and figures, flat."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from nsm.errors import NsmError

Figure = float | str | None

# settings that change nothing in a result
_INCIDENTAL = ("resume", "logger", "artefacts", "trainer.progress")


@dataclass(frozen=True)
class Run:
    """A complete run.

    Attributes:
        folder: where it lies.
        name: its path below the folder in which it was found.
        task: overfit, param, ...
        settings: "group.key" to value.
        figures: name to number, yes or no; None for a number that is not finite.
    """

    folder: Path
    name: str
    task: str
    settings: dict[str, Any]
    figures: dict[str, Figure]


@dataclass(frozen=True)
class Incomplete:
    """A run, or a part of one, that cannot be shown, and why."""

    name: str
    reason: str


def find_runs(folders: Sequence[Path]) -> tuple[list[Run], list[Incomplete]]:
    """All runs in the folders, however deep, in the order of their names.

    Raises:
        NsmError: a folder that is not there; no run at all.
    """
    runs: list[Run] = []
    incomplete: list[Incomplete] = []
    seen: set[Path] = set()
    for folder in folders:
        if not folder.is_dir():
            raise NsmError(f"{folder}: no such folder; give folders of runs or sweeps")
        for place in run_folders(folder):
            if place.resolve() in seen:
                continue
            seen.add(place.resolve())
            inner = place.relative_to(folder).as_posix()
            name = place.resolve().name if inner == "." else inner
            if len(folders) > 1 and inner != ".":
                name = f"{folder.resolve().name}/{inner}"
            if not (place / "metrics.json").exists():
                incomplete.append(Incomplete(name, _unfinished(place)))
                continue
            try:
                runs.append(_read(place, name))
            except NsmError as error:
                incomplete.append(Incomplete(name, str(error)))
    if not runs and not incomplete:
        words = ", ".join(str(folder) for folder in folders)
        raise NsmError(f"{words}: no run there; a run's folder has a metrics.json")
    return runs, incomplete


def run_folders(folder: Path) -> Iterator[Path]:
    """The folders of runs, complete or not, in a folder, however deep."""
    for path, inner, files in os.walk(folder):
        inner.sort(key=lambda name: (len(name), name) if name.isdigit() else (0, name))
        if not {"metrics.json", "config.yaml", "error.txt"}.isdisjoint(files):
            yield Path(path)
        if "metrics.json" in files:
            inner.clear()  # what lies in a run's folder belongs to it


def _unfinished(folder: Path) -> str:
    """Why there are no figures: what a sweep wrote down of a job that failed, if it did."""
    try:
        lines = (folder / "error.txt").read_text(encoding="utf-8").strip().splitlines()
    except (OSError, ValueError):
        lines = []
    return f"failed: {lines[-1][:300]}" if lines else "no metrics.json: not finished"


def _read(folder: Path, name: str) -> Run:
    try:
        words = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        figures = _figures(words)
    except (OSError, ValueError, RecursionError, TypeError) as error:
        raise NsmError(f"metrics.json is damaged: {_short(error)}") from error
    try:
        config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
        if not isinstance(config, dict):
            raise ValueError("no settings in it")
        settings = dict(_flat(config))
        task = settings.pop("task.name")
    except FileNotFoundError as error:
        raise NsmError("config.yaml is missing") from error
    except Exception as error:  # whatever a damaged or foreign file raises
        raise NsmError(f"config.yaml is damaged: {_short(error)}") from error
    return Run(folder, name, str(task), settings, figures)


def _flat(words: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in words.items():
        name = f"{prefix}{key}"
        if name in _INCIDENTAL:
            continue
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{name}.")
        else:
            yield name, value


def _figures(words: Any) -> dict[str, Figure]:
    """Figures of metrics.json by one name each.

    Of ``task=param`` those of nsm have plain names, those of a collection's pairs their mean.
    """
    if not isinstance(words, Mapping) or not isinstance(words.get("metrics"), Mapping):
        raise ValueError("no figures in it")
    figures = _numbers({key: words[key] for key in ("steps", "seconds") if key in words})
    aside: dict[str, Figure] = {}
    for key, value in words["metrics"].items():
        if key == "nsm" and isinstance(value, Mapping):
            figures.update(_numbers(value))
        elif key == "pairs" and isinstance(value, Mapping):
            pairs = {name: _numbers(of_pair) for name, of_pair in value.items()}
            figures.update(_means(list(pairs.values())))
            aside.update({f"{name}: {k}": v for name, own in pairs.items() for k, v in own.items()})
        elif isinstance(value, Mapping):
            aside.update({f"{key}: {k}": v for k, v in _numbers(value).items()})
        else:
            figures.update(_numbers({key: value}))
    return {**figures, **aside}


def _numbers(words: Mapping[str, Any]) -> dict[str, Figure]:
    """What of words can stand in a table: numbers, and yes or no."""
    result: dict[str, Figure] = {}
    for key, value in words.items():
        if isinstance(value, bool):
            result[key] = "yes" if value else "no"
        elif isinstance(value, (int, float)):
            # JSON of other writers may hold NaN
            result[key] = value if abs(value) < float("inf") else None
        elif value is None:
            result[key] = None
    return result


def _means(pairs: Sequence[Mapping[str, Figure]]) -> dict[str, Figure]:
    """The mean of each figure that all pairs have; of yes and no, whether all say yes."""
    result: dict[str, Figure] = {}
    for key in pairs[0] if pairs else ():
        values = [pair.get(key) for pair in pairs]
        numbers = [value for value in values if isinstance(value, (int, float))]
        if all(value in ("yes", "no") for value in values):
            result[key] = "yes" if all(value == "yes" for value in values) else "no"
        else:
            result[key] = sum(numbers) / len(numbers) if len(numbers) == len(values) else None
    return result


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__
