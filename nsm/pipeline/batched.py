"""Jobs of a sweep that are trained in one batch, each with its own folder as if it were alone."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from nsm.config import register_resolvers
from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.pipeline.common import (
    Run,
    configured_surface,
    report_surface,
    settle_path,
    stored_config,
)
from nsm.pipeline.folder_lock import folder_lock
from nsm.pipeline.overfit import common_settings, leave_results, overfit_ensemble
from nsm.pipeline.sweep_jobs import ERROR_FILE, attempted, job_config, run_job
from nsm.sweeps import is_complete
from nsm.tasks.ensemble import EnsembleSplit

Call = tuple[dict[str, Any], str, str]  # settings, folder and cwd, as for run_job
Ended = tuple[int, "str | None"]  # number of a job, and why it failed


def batches(settings: Sequence[dict[str, Any]], at_once: int) -> list[list[int]]:
    """Which jobs are trained in one batch.

    Args:
        settings: of each job, as plain dictionaries and lists.
        at_once: how many at most.

    Returns:
        The numbers of the jobs of each batch; one that has to run alone is a batch of one.
    """
    alike: dict[str, list[int]] = {}
    for number, one in enumerate(settings):
        common = common_settings(one)
        key = f"alone {number}" if common is None else json.dumps(common, sort_keys=True)
        alike.setdefault(key, []).append(number)
    return [
        numbers[start : start + at_once]
        for numbers in alike.values()
        for start in range(0, len(numbers), at_once)
    ]


@dataclass(frozen=True)
class _Job:
    """A job that is ready to be trained, with the lock on its folder."""

    number: int
    call: Call
    lock: ExitStack
    run: Run
    surface: Surface

    def alone(self) -> Ended:
        self.lock.close()
        return self.number, run_job(*self.call, log=False)


def run_batched(calls: Sequence[Call]) -> Iterator[Ended]:
    """Run jobs with :func:`nsm.pipeline.overfit.common_settings` in one batch.

    Those that cannot be prepared fail alone. What is not at the same step as the others, or goes
    wrong in the training, goes on alone from its own checkpoint.

    Args:
        calls: of each job, settings, folder and working folder, as for
            :func:`nsm.pipeline.sweep_jobs.run_job`.

    Yields:
        The number of each job as it ends, and why it failed, in one line, or None.
    """
    started = time.monotonic()
    os.chdir(calls[0][2])
    register_resolvers()
    console = Console(highlight=False, markup=False)
    surfaces: dict[str, Surface] = {}
    stages: dict[Any, list[_Job]] = {}
    with ExitStack() as locks:
        for number, call in enumerate(calls):
            settings, place = call[0], Path(call[1])
            lock = locks.enter_context(ExitStack())
            try:
                lock.enter_context(folder_lock(place))
            except NsmError as told:  # another process is at work on it
                yield number, str(told)
                continue
            ready, error = attempted(place, partial(_ready, settings, place, surfaces, console))
            if ready is None:
                lock.close()
                yield number, error
                continue
            job = _Job(number, call, lock, *ready)
            stages.setdefault(job.run.stage, []).append(job)
        for stage, jobs in stages.items():
            if stage is None:
                yield from (job.alone() for job in jobs)
            else:
                yield from _train(jobs, console, started)


def _ready(
    settings: dict[str, Any], place: Path, surfaces: dict[str, Surface], console: Console
) -> tuple[Run, Surface] | None:
    """A job and its surface, of which each is prepared once; None if the job is complete."""
    (place / ERROR_FILE).unlink(missing_ok=True)
    if is_complete(place):  # another sweep has been at it
        return None
    config = job_config(settings, place)
    resuming = config.resume is not None
    if resuming:
        config = stored_config(place)
    settle_path(config)
    key = f"{config.surface} {config.domain}"
    if key not in surfaces:
        surfaces[key] = configured_surface(config)
        report_surface(console, surfaces[key])
    return Run(config, place, resuming), surfaces[key]


def _train(jobs: list[_Job], console: Console, started: float) -> Iterator[Ended]:
    while len(jobs) > 1:
        try:
            modules, trainer = overfit_ensemble(
                [job.run for job in jobs], [job.surface for job in jobs], console
            )
            break
        except Exception as fault:
            # whatever it is, the job that it concerns will say it again
            reason = " ".join(str(fault).split())[:200]
            which = fault.which if isinstance(fault, EnsembleSplit) else range(len(jobs))
            console.print(f"{reason}; {len(which)} of {len(jobs)} jobs go on alone")
            yield from (jobs[i].alone() for i in which)
            left = [job for i, job in enumerate(jobs) if i not in which]
            # they may have checkpoints by now
            jobs = [replace(job, run=replace(job.run, resuming=True)) for job in left]
    else:
        yield from (job.alone() for job in jobs)
        return
    for index, (job, module) in enumerate(zip(jobs, modules, strict=True)):
        run = job.run
        given = run.config, run.folder, job.surface, module, trainer, console, started
        error = attempted(run.folder, partial(leave_results, *given, index=index))[1]
        job.lock.close()
        yield job.number, error
