"""Sweeps: the names of their folders, and the outcomes of their jobs."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override

from nsm.wording import number_of

# settings that do not change what a job leaves
_INCIDENTAL = {"resume"}
_LONGEST = 60  # characters of a folder's name before its hash


@dataclass(frozen=True)
class Job:
    """A job to run: all settings, its folder, and the overrides that distinguish it."""

    settings: dict[str, Any]
    folder: Path
    overrides: tuple[str, ...]

    @property
    def call(self) -> tuple[dict[str, Any], str, str]:
        """The arguments of :func:`nsm.pipeline.sweep_jobs.run_job`."""
        return self.settings, str(self.folder.absolute()), os.getcwd()


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job.

    Attributes:
        overrides: those that distinguish the job.
        folder: its run folder.
        error: why it failed, in one line; None if it is complete.
        before: it was complete when the sweep began.
    """

    overrides: tuple[str, ...]
    folder: Path
    error: str | None = None
    before: bool = False


# of the jobs of this process's sweep, for the command's summary and exit status
OUTCOMES: list[Outcome] = []


def overrides_of(
    arguments: Iterable[str],
    params: Mapping[str, Any] | None,
    loader: ConfigLoader | None = None,
) -> list[Override]:
    """The overrides of a sweep: its sweeper's ``params``, then the arguments, each key once.

    Args:
        arguments: of the command line.
        params: of the sweeper.
        loader: finds the options that ``GROUP=glob(*)`` stands for.
    """
    texts = [f"{key}={value}" for key, value in (params or {}).items()]
    parsed = OverridesParser.create(loader).parse_overrides([*texts, *arguments])
    return list({override.get_key_element(): override for override in parsed}.values())


def swept_keys(arguments: Iterable[str], params: Mapping[str, Any] | None) -> list[str]:
    """The keys that take several values in a sweep."""
    return [o.get_key_element() for o in overrides_of(arguments, params) if o.is_sweep_override()]


def sweep_folder(task: str, arguments: Sequence[str]) -> str:
    """``outputs/TASK/sweep-WHAT`` with a hash of the fixed settings.

    The swept values have no part in it, so that a sweep can be widened in its folder.
    """
    preset = [one.split("=")[1] for one in arguments if one.startswith("sweep=")]
    given = overrides_of(arguments, {})
    swept = [o.get_key_element() for o in given if o.is_sweep_override()]
    name = _name([*preset, *(key.split(".")[-1] for key in swept)]) or "one"
    fixed = [
        str(o.input_line)
        for o in given
        if not o.is_sweep_override() and not str(o.input_line).startswith("sweep=")
    ]
    parts = ["sweep", name, *([_hash(sorted(fixed))] if fixed else [])]
    return f"outputs/{task}/{'-'.join(parts)}"


def job_folder(sweep: Path, settings: Mapping[str, Any], overrides: Iterable[str]) -> Path:
    """The folder of a job: the same for the same settings, whichever overrides gave them.

    Args:
        sweep: the sweep's folder.
        settings: all settings of the job, resolved.
        overrides: those that distinguish it, for a readable name.
    """
    own = _hash({key: value for key, value in settings.items() if key not in _INCIDENTAL})
    there = sorted(sweep.glob(f"*-{own}"))
    if there:
        return there[0]
    pairs = (override.split("=", 1) for override in overrides)
    name = _name(f"{key.split('.')[-1]}_{value}" for key, value in pairs)
    return sweep / "-".join([name or "job", own])


def is_complete(folder: Path) -> bool:
    """Whether a run has all its results: its figures are written last."""
    return (folder / "metrics.json").is_file()


def summary(outcomes: Sequence[Outcome]) -> str:
    """The outcome of a sweep in one line."""
    complete = [o for o in outcomes if o.error is None]
    before = sum(o.before for o in complete)
    jobs = number_of(len(outcomes), "job")
    text = f"{jobs} in {outcomes[0].folder.parent}: {len(complete)} complete"
    if before:
        text += f" ({before} of them before)"
    failed = len(outcomes) - len(complete)
    return text + (f", {failed} failed; the same command tries those again" if failed else "")


def _name(parts: Iterable[str]) -> str:
    return re.sub(r"[^\w.-]+", "_", "-".join(parts))[:_LONGEST].strip("_.-")


def _hash(settings: Any) -> str:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
