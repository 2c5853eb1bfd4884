"""Sweeps: what their folders are called, and what became of their jobs."""

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

# settings that do not change what a job leaves
_INCIDENTAL = {"resume"}
_LONGEST = 60  # letters of a folder's name before its hash


@dataclass(frozen=True)
class Job:
    """A job to run: all settings, its folder, and the words that set it apart."""

    settings: dict[str, Any]
    folder: Path
    words: tuple[str, ...]

    @property
    def call(self) -> tuple[dict[str, Any], str, str]:
        """The arguments of :func:`nsm.pipeline.sweep_jobs.run_job`."""
        return self.settings, str(self.folder.absolute()), os.getcwd()


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        words: the overrides that set the job apart.
        folder: its run folder.
        error: why it failed, in one line; None if it is complete.
        before: it was complete already when the sweep began.
    """

    words: tuple[str, ...]
    folder: Path
    error: str | None = None
    before: bool = False


# what became of the jobs of this process's sweep: the command's summary and exit status
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


def swept_keys(words: Iterable[str], params: Mapping[str, Any] | None) -> list[str]:
    """The keys that take several values in a sweep."""
    return [o.get_key_element() for o in overrides_of(words, params) if o.is_sweep_override()]


def sweep_folder(task: str, words: Sequence[str], params: Mapping[str, Any] | None) -> str:
    """``outputs/TASK/sweep-WHAT``, with a hash of what is fixed; the values swept have no part
    in it, so that a sweep can be widened in its folder."""
    preset = [word.split("=")[1] for word in words if word.startswith("sweep=")]
    swept = [o.get_key_element() for o in overrides_of(words, {}) if o.is_sweep_override()]
    name = _name([*preset, *(key.split(".")[-1] for key in swept)]) or "one"
    fixed = [
        str(o.input_line)
        for o in overrides_of(words, {})
        if not o.is_sweep_override() and not str(o.input_line).startswith("sweep=")
    ]
    parts = ["sweep", name, *([_hash(sorted(fixed))] if fixed else [])]
    return f"outputs/{task}/{'-'.join(parts)}"


def job_folder(sweep: Path, settings: Mapping[str, Any], words: Iterable[str]) -> Path:
    """The folder of a job: the same for the same settings, however they were given.

    Args:
        sweep: the sweep's folder.
        settings: all settings of the job, resolved.
        words: the overrides that set it apart, for people to read.
    """
    own = _hash({key: value for key, value in settings.items() if key not in _INCIDENTAL})
    there = sorted(sweep.glob(f"*-{own}"))
    if there:
        return there[0]
    pairs = (word.split("=", 1) for word in words)
    name = _name(f"{key.split('.')[-1]}_{value}" for key, value in pairs)
    return sweep / "-".join([name or "job", own])


def is_complete(folder: Path) -> bool:
    """Whether a run has left all its results: its figures are written last."""
    return (folder / "metrics.json").is_file()


def summary(outcomes: Sequence[Outcome]) -> str:
    """How a sweep went, in one line."""
    complete = [o for o in outcomes if o.error is None]
    before = sum(o.before for o in complete)
    text = f"{len(outcomes)} jobs in {outcomes[0].folder.parent}: {len(complete)} complete"
    if before:
        text += f" ({before} of them before)"
    failed = len(outcomes) - len(complete)
    return text + (f", {failed} failed; the same command tries those again" if failed else "")


def _name(words: Iterable[str]) -> str:
    return re.sub(r"[^\w.-]+", "_", "-".join(words))[:_LONGEST].strip("_.-")


def _hash(words: Any) -> str:
    return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:8]
