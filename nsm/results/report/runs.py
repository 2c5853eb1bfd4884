"""The runs in folders, with flat settings and figures."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from nsm.errors import NsmError
from nsm.results.readable_settings import readable

Figure = float | str | None

_NAMED = 4  # surfaces of a collection in its name


@dataclass(frozen=True)
class Run:
    """A complete run.

    Attributes:
        folder: of the run.
        name: its path below the folder that was searched.
        task: overfit, param, ...
        subject: what it is of: a surface, "source → target", or the surfaces of a collection.
        settings: values by "group.key"; the class or name that a group chooses by "group".
        figures: numbers, yes or no by name; None for a number that is not finite.
        warnings: what the run warned of at its end.
    """

    folder: Path
    name: str
    task: str
    subject: str
    settings: dict[str, Any]
    figures: dict[str, Figure]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Incomplete:
    """A run, or a file of one, that cannot be shown, and the reason."""

    name: str
    reason: str


def find_runs(folders: Sequence[Path]) -> tuple[list[Run], list[Incomplete]]:
    """All runs in the folders and their subfolders, sorted by name.

    Raises:
        NsmError: ``missing_folder`` or ``no_runs``, with the folder as the key.
    """
    runs: list[Run] = []
    incomplete: list[Incomplete] = []
    seen: set[Path] = set()
    for folder in folders:
        if not folder.is_dir():
            reason = f"{folder}: no such folder; give folders of runs or sweeps"
            raise NsmError(reason, kind="missing_folder", key=str(folder))
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
        listing = ", ".join(str(folder) for folder in folders)
        reason = f"{listing}: no runs found; the folder of a run has a metrics.json"
        raise NsmError(reason, kind="no_runs", key=listing)
    return runs, incomplete


def run_folders(folder: Path) -> Iterator[Path]:
    """The folders of runs, complete or not, in a folder and its subfolders."""
    for path, inner, files in os.walk(folder):
        inner.sort(key=_by_number)
        if not {"metrics.json", "config.yaml", "error.txt"}.isdisjoint(files):
            yield Path(path)
        if "metrics.json" in files:
            inner.clear()  # subfolders of a run belong to it


def _by_number(name: str) -> list[str | float]:
    """A key for sorting: numbers in a name by their value, so that 32 comes before 128."""
    parts = re.split(r"(\d+(?:\.\d+)?)", name)
    return [float(part) if k % 2 else part for k, part in enumerate(parts)]


def _unfinished(folder: Path) -> str:
    """Why a run has no figures: the error that a sweep recorded for a failed job, if any."""
    try:
        lines = (folder / "error.txt").read_text(encoding="utf-8").strip().splitlines()
    except (OSError, ValueError):
        lines = []
    return f"failed: {lines[-1][:300]}" if lines else "no metrics.json: not finished"


def _read(folder: Path, name: str) -> Run:
    try:
        stored = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        figures = _figures(stored)
    except (OSError, ValueError, RecursionError, TypeError) as error:
        raise _damaged(f"metrics.json is damaged: {short(error)}", folder) from error
    try:
        config = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
        if not isinstance(config, dict):
            raise ValueError("it has no settings")
        settings = readable(config)
        task = settings.pop("task")
    except FileNotFoundError as error:
        raise _damaged("config.yaml is missing", folder) from error
    except Exception as error:  # a damaged or foreign file raises any exception
        raise _damaged(f"config.yaml is damaged: {short(error)}", folder) from error
    said = stored.get("warnings")  # absent in older run folders
    warnings = tuple(map(str, said)) if isinstance(said, list) else ()
    return Run(folder, name, str(task), _subject(stored), settings, figures, warnings)


def _subject(stored: Mapping[str, Any]) -> str:
    surfaces = stored.get("surfaces")
    if isinstance(surfaces, list) and surfaces:
        few = [str(name) for name in surfaces[:_NAMED]]
        more = [f"{len(surfaces) - _NAMED} more"] if len(surfaces) > _NAMED else []
        return ", ".join([*few, *more])
    ends = [str(stored[key]) for key in ("surface", "target") if isinstance(stored.get(key), str)]
    return " → ".join(ends)


def _damaged(reason: str, folder: Path) -> NsmError:
    return NsmError(reason, kind="damaged_file", key=str(folder))


def _figures(content: Any) -> dict[str, Figure]:
    """The figures of metrics.json, flat.

    Those of nsm among the maps of ``task=param`` keep their names; those of a collection are the
    means over its pairs.
    """
    if not isinstance(content, Mapping) or not isinstance(content.get("metrics"), Mapping):
        raise ValueError("it has no figures")
    figures = _numbers({key: content[key] for key in ("steps", "seconds") if key in content})
    others: dict[str, Figure] = {}
    for key, value in content["metrics"].items():
        if key == "nsm" and isinstance(value, Mapping):
            figures.update(_numbers(value))
        elif key == "pairs" and isinstance(value, Mapping):
            pairs = {name: _numbers(of_pair) for name, of_pair in value.items()}
            figures.update(_means(list(pairs.values())))
            for name, of_pair in pairs.items():
                others.update({f"{name}: {k}": v for k, v in of_pair.items()})
        elif isinstance(value, Mapping):
            others.update({f"{key}: {k}": v for k, v in _numbers(value).items()})
        else:
            figures.update(_numbers({key: value}))
    return {**figures, **others}


def _numbers(figures: Mapping[str, Any]) -> dict[str, Figure]:
    """The figures that fit in a table: numbers, and yes or no."""
    result: dict[str, Figure] = {}
    for key, value in figures.items():
        if isinstance(value, bool):
            result[key] = "yes" if value else "no"
        elif isinstance(value, (int, float)):
            # other writers of JSON allow NaN
            result[key] = value if abs(value) < float("inf") else None
        elif value is None:
            result[key] = None
    return result


def _means(pairs: Sequence[Mapping[str, Figure]]) -> dict[str, Figure]:
    """The mean of each figure that all pairs have; yes if all pairs have yes."""
    result: dict[str, Figure] = {}
    for key in pairs[0] if pairs else ():
        values = [pair.get(key) for pair in pairs]
        numbers = [value for value in values if isinstance(value, (int, float))]
        if all(value in ("yes", "no") for value in values):
            result[key] = "yes" if all(value == "yes" for value in values) else "no"
        else:
            result[key] = sum(numbers) / len(numbers) if len(numbers) == len(values) else None
    return result


def short(error: Exception) -> str:
    """The message of an error in one line of at most 120 characters."""
    return " ".join(str(error).split())[:120] or type(error).__name__
