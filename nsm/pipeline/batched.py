"""Overfits that are trained in one batch, each with its own folder as if it were alone."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
from rich.console import Console

from nsm.data import EnsembleData, SurfaceData
from nsm.domains import Surface, domain
from nsm.errors import NsmError
from nsm.instantiation import made, target_of
from nsm.maps.networks import SKIPS
from nsm.pipeline.automatic_domain import choose_domain, is_automatic
from nsm.pipeline.configured_surface import (
    configured_surface,
    keep_absolute,
    named_mesh,
    report_surface,
)
from nsm.pipeline.folder_lock import folder_lock
from nsm.pipeline.overfit import OverfitTask
from nsm.pipeline.runner import built, finish, make_task
from nsm.pipeline.sweep_jobs import ERROR_FILE, attempted, job_run, run_job
from nsm.pipeline.training import Run, plain, trained
from nsm.plugins import import_here
from nsm.results.callbacks import Pictures
from nsm.results.loggers import WandB
from nsm.results.meshes import ColouredMesh
from nsm.sweeps import is_complete
from nsm.tasks import Overfit, OverfitEnsemble
from nsm.tasks.ensemble import EnsembleSplit
from nsm.tasks.joint_optimizer import shared_options
from nsm.wording import number_of

Call = tuple[dict[str, Any], str, str]  # settings, folder and cwd, as for run_job
Ended = tuple[int, "str | None"]  # number of a job, and why it failed


def common_settings(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the settings of trainings must have in common to be made in one batch.

    Surface, seed, loss weights and the optimizer's rates may differ.

    Args:
        settings: the whole configuration, as plain dictionaries and lists.

    Returns:
        None if the training has to be made alone.
    """
    trainer, optimizer = settings["trainer"], shared_options(settings["optimizer"])
    loggers = [logger["_target_"] for logger in settings["logger"].values()]
    if (
        settings["task"]["_target_"] != target_of(OverfitTask)
        or settings["data"]["_target_"] not in (target_of(SurfaceData), "nsm.data.SurfaceData")
        or settings["map"]["block"] not in SKIPS
        # each surface has a grid of its own lattice
        or not (is_automatic(settings["domain"]) or domain(settings["domain"]).has_boundary)
        or settings["loss_terms"]
        or settings["callbacks"]
        or optimizer is None
        or trainer["devices"] > 1
        # these act on the gradients of all
        or (trainer["stop_gradient_norm"], trainer["gradient_clip"]) != (None, None)
        # one run at a time
        or any(
            logger in (target_of(WandB), "pytorch_lightning.loggers.WandbLogger")
            for logger in loggers
        )
    ):
        return None
    own = ("surface", "domain", "seed", "artefacts", "resume", "loss_weights")
    rest = {key: value for key, value in settings.items() if key not in own}
    return {**rest, "optimizer": optimizer}


@dataclass(frozen=True)
class Member:
    """A run of task=overfit in a batch, with its prepared surface."""

    run: Run
    task: OverfitTask


def member(run: Run, surface: Surface, console: Console) -> Member:
    """A member of a batch."""
    task = make_task(run.config, console)
    assert isinstance(task, OverfitTask)
    task.use(surface)
    return Member(run, task)


def overfit_ensemble(
    members: Sequence[Member], console: Console
) -> tuple[list[Overfit], pl.Trainer]:
    """Train several networks in one batch, each in its run folder, as each would be alone.

    Args:
        members: with :func:`common_settings`, and checkpoints of one step if they go on.
        console: where to print.

    Returns:
        The trained modules, and the trainer, for :func:`nsm.pipeline.runner.finish`.

    Raises:
        NsmError: settings that do not fit together.
        EnsembleSplit: some have to be trained alone; all have whole checkpoints, if any.
    """
    modules: list[Overfit] = []
    starts: dict[tuple[int, int], Overfit] = {}
    for one in members:
        key = id(one.task.surface), one.run.config.seed
        one.task.start = starts.get(key)
        modules.append(built(one.task))
        starts.setdefault(key, modules[-1])
    task_of = {module: one.task for module, one in zip(modules, members, strict=True)}

    def picture(module: Any) -> np.ndarray:
        return task_of[module].picture(module)

    def mesh(module: Any) -> ColouredMesh | None:
        return task_of[module].mesh(module)

    config = members[0].run.config
    settings = plain(config)["data"]
    settings.pop("_target_")
    data = EnsembleData(
        [one.task.surface for one in members],
        made(config.sampler),
        [one.run.config.seed for one in members],
        **settings,
    )
    trainer = trained(
        [one.run for one in members],
        data,
        OverfitEnsemble(modules),
        console,
        Pictures(
            OverfitTask.picture_name,
            picture,
            config.trainer.log_pictures,
            mesh,
            config.trainer.log_meshes,
            config.trainer.log_histograms,
        ),
        f"overfit {len(members)} networks",
    )
    return modules, trainer


def batches(settings: Sequence[dict[str, Any]], at_once: int) -> list[list[int]]:
    """Which jobs are trained in one batch.

    Args:
        settings: of each job, as plain dictionaries and lists.
        at_once: how many at most.

    Returns:
        The numbers of the jobs of each batch; one that has to run alone is a batch of one.
    """
    groups: dict[str, list[int]] = {}
    for number, one in enumerate(settings):
        common = common_settings(one)
        key = f"alone {number}" if common is None else json.dumps(common, sort_keys=True)
        groups.setdefault(key, []).append(number)
    return [
        numbers[start : start + at_once]
        for numbers in groups.values()
        for start in range(0, len(numbers), at_once)
    ]


@dataclass(frozen=True)
class _Job:
    """A job that is ready to be trained, with the lock on its folder."""

    number: int
    call: Call
    lock: ExitStack
    member: Member

    def alone(self) -> Ended:
        self.lock.close()
        return self.number, run_job(*self.call, log=False)


def run_batched(calls: Sequence[Call]) -> Iterator[Ended]:
    """Run jobs with :func:`common_settings` in one batch.

    Those that cannot be prepared fail alone. Jobs that are not at the same step as the others, or
    fail in the training, go on alone from their own checkpoints.

    Args:
        calls: of each job, settings, folder and working folder, as for
            :func:`nsm.pipeline.sweep_jobs.run_job`.

    Yields:
        The number of each job as it ends, and why it failed, in one line, or None.
    """
    started = time.monotonic()
    os.chdir(calls[0][2])
    import_here()
    console = Console(highlight=False, markup=False)
    surfaces: dict[str, Surface] = {}
    stages: dict[Any, list[_Job]] = {}
    with ExitStack() as locks:
        for number, call in enumerate(calls):
            settings, place = call[0], Path(call[1])
            lock = locks.enter_context(ExitStack())
            try:
                lock.enter_context(folder_lock(place))
            except NsmError as error:  # another process is at work on it
                yield number, str(error)
                continue
            ready, reason = attempted(place, partial(_ready, settings, place, surfaces, console))
            if ready is None:
                lock.close()
                yield number, reason
                continue
            # networks on closed domains differ by their lattices
            stage = ready.run.stage if ready.task.domain.has_boundary else None
            stages.setdefault(stage, []).append(_Job(number, call, lock, ready))
        for stage, jobs in stages.items():
            if stage is None:
                yield from (job.alone() for job in jobs)
            else:
                yield from _train(jobs, console, started)


def _ready(
    settings: dict[str, Any], place: Path, surfaces: dict[str, Surface], console: Console
) -> Member | None:
    """A job with its surface, of which each is prepared once; None if the job is complete."""
    (place / ERROR_FILE).unlink(missing_ok=True)
    if is_complete(place):  # another sweep has been at it
        return None
    run = job_run(settings, place)
    keep_absolute(run.config)
    if is_automatic(run.config.domain):
        choose_domain(run.config, [named_mesh(run.config)], console, closed=True)
    key = f"{run.config.surface} {run.config.domain}"
    if key not in surfaces:
        surfaces[key] = configured_surface(run.config, console)
        report_surface(console, surfaces[key])
    return member(run, surfaces[key], console)


def _train(jobs: list[_Job], console: Console, started: float) -> Iterator[Ended]:
    while len(jobs) > 1:
        try:
            modules, trainer = overfit_ensemble([job.member for job in jobs], console)
            break
        except Exception as fault:
            # whatever it is, the job that it concerns will report it again
            reason = " ".join(str(fault).split())[:200]
            which = fault.which if isinstance(fault, EnsembleSplit) else range(len(jobs))
            console.print(
                f"{reason}; going on alone: {len(which)} of {number_of(len(jobs), 'job')}"
            )
            yield from (jobs[i].alone() for i in which)
            # the others may have checkpoints by now
            jobs = [_resuming(job) for i, job in enumerate(jobs) if i not in which]
    else:
        yield from (job.alone() for job in jobs)
        return
    for index, (job, module) in enumerate(zip(jobs, modules, strict=True)):
        task, run = job.member.task, job.member.run
        work = partial(finish, task, run, module, trainer, started, index=index)
        error = attempted(run.folder, work)[1]
        job.lock.close()
        yield job.number, error


def _resuming(job: _Job) -> _Job:
    return replace(job, member=replace(job.member, run=replace(job.member.run, resuming=True)))
