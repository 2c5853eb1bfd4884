"""Launchers: where the jobs of a sweep run.

All of them check the settings of every job before the first starts, skip complete jobs, and go on
with the others when one fails. A job is plain settings and a folder, so that the process that runs
it needs nothing of Hydra.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from nsm.errors import NsmError
from nsm.loading_libraries import loading_libraries
from nsm.optional_dependencies import needed
from nsm.sweeps import OUTCOMES, Job, Outcome, is_complete, job_folder, swept_keys

_KILLED = "its process was killed, perhaps because memory ran out"
_POLL = 0.5  # seconds


Finished = tuple[Job, "str | None"]  # with what made it fail


class SweepLauncher(Launcher):
    """Base of the launchers; subclasses run jobs."""

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.config, self.loader = config, hydra_context.config_loader

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs; their outcomes are in the return values.

        Raises:
            NsmError: settings of a job that cannot be used, before any job starts.
        """
        jobs = [self._job(overrides) for overrides in job_overrides]
        outcomes = {
            job.folder: Outcome(job.overrides, job.folder, before=True)
            for job in jobs
            if is_complete(job.folder)
        }
        for outcome in outcomes.values():
            self._say(f"complete before: {_label(outcome)}")
        waiting = {job.folder: job for job in jobs if job.folder not in outcomes}
        for number, (job, error) in enumerate(self.run(list(waiting.values())), start=1):
            outcome = Outcome(job.overrides, job.folder, error)
            outcomes[job.folder] = outcome
            became = f"failed: {_label(outcome)}: {error}" if error else f"done: {_label(outcome)}"
            self._say(f"[{number}/{len(waiting)}] {became}")
        OUTCOMES.extend(outcomes.values())
        return [_returned(outcomes[job.folder]) for job in jobs]

    def run(self, jobs: list[Job]) -> Iterator[Finished]:
        """Run the jobs, and yield each as it ends."""
        raise NotImplementedError

    def _job(self, overrides: Sequence[str]) -> Job:
        with loading_libraries(frozen=True):
            from nsm.config_validation import checked
            from nsm.pipeline import sweep_jobs  # noqa: F401  # which the jobs need

        hydra = self.config.hydra
        keys = swept_keys(hydra.overrides.task, hydra.sweeper.params)
        own = tuple(one for one in overrides if one.split("=")[0] in keys)
        config = self.loader.load_sweep_config(self.config, list(overrides))
        with open_dict(config):
            del config["hydra"]
        try:
            settings: Any = OmegaConf.to_container(checked(config, overrides))
        except NsmError as error:
            raise NsmError(
                f"{' '.join(own) or 'the job'}: {error}", kind=error.kind, key=error.key
            ) from error
        return Job(settings, job_folder(Path(hydra.sweep.dir), settings, own), own)

    def _say(self, line: str) -> None:
        print(line, flush=True)


class Serial(SweepLauncher):
    """One job after the other in this process."""

    def run(self, jobs: list[Job]) -> Iterator[Finished]:
        from nsm.pipeline.sweep_jobs import run_job

        for job in jobs:
            self._say(f"next: {' '.join(job.overrides) or job.folder.name}")
            yield job, run_job(*job.call, log=False)


class Batched(SweepLauncher):
    """Jobs of task=overfit with equal networks and settings in one batch, the others in turn.

    Args:
        at_once: jobs in a batch, at most.
    """

    def __init__(self, at_once: int) -> None:
        self.at_once = at_once

    def run(self, jobs: list[Job]) -> Iterator[Finished]:
        from nsm.pipeline.batched import batches, run_batched
        from nsm.pipeline.sweep_jobs import run_job

        if self.at_once < 1:
            raise NsmError(
                "setting hydra.launcher.at_once: it must be at least 1",
                kind="out_of_range",
                key="hydra.launcher.at_once",
            )
        for numbers in batches([job.settings for job in jobs], self.at_once):
            batch = [jobs[number] for number in numbers]
            names = [" ".join(job.overrides) or job.folder.name for job in batch]
            if len(batch) == 1:
                self._say(f"next: {names[0]}")
                yield batch[0], run_job(*batch[0].call, log=False)
                continue
            self._say(f"next, {len(batch)} in one batch: {'; '.join(names)}")
            for number, error in run_batched([job.call for job in batch]):
                yield batch[number], error


class Joblib(SweepLauncher):
    """Processes on this machine.

    Args:
        n_jobs: jobs at a time; -1 for as many as there are cores.
    """

    def __init__(self, n_jobs: int) -> None:
        self.n_jobs = n_jobs

    def run(self, jobs: list[Job]) -> Iterator[Finished]:
        joblib = needed("joblib", "hydra/launcher=joblib")
        left = list(jobs)
        try:
            for place, error in self._pool(joblib, self.n_jobs, jobs):
                job = next(job for job in left if job.folder == place)
                left.remove(job)
                yield job, error
            return
        except BrokenProcessPool:
            pass
        # A killed process takes the pool with it. The rest runs singly, which shows the job that
        # kills; with two places for one job joblib still makes a process for it.
        for job in left:
            try:
                yield job, next(iter(self._pool(joblib, 2, [job])))[1]
            except BrokenProcessPool:
                yield job, _KILLED

    def _pool(self, joblib: Any, size: int, jobs: list[Job]) -> Iterator[tuple[Path, str | None]]:
        pool = joblib.Parallel(
            n_jobs=size,
            backend="loky",
            return_as="generator_unordered",
            pre_dispatch="all",
            batch_size=1,
        )
        return pool(joblib.delayed(run_in_process)(job.folder, *job.call) for job in jobs)


class Submitit(SweepLauncher):
    """Jobs of a SLURM cluster, or local processes for a trial.

    Args:
        cluster: ``slurm`` or ``local``.
        parallel: jobs at a time; None for no limit.
        timeout_min: minutes that a job may take; one that is cut off is queued again.
        cpus_per_task, gpus_per_node, mem_gb: of each job.
        parameters: further ones of ``submitit.AutoExecutor.update_parameters``.
    """

    def __init__(
        self,
        cluster: str,
        parallel: int | None,
        timeout_min: int,
        cpus_per_task: int,
        gpus_per_node: int,
        mem_gb: float,
        parameters: dict[str, Any],
    ) -> None:
        self.cluster, self.parallel = cluster, parallel
        shared = {
            "timeout_min": timeout_min,
            "cpus_per_task": cpus_per_task,
            "gpus_per_node": gpus_per_node,
            "mem_gb": mem_gb,
        }
        self.parameters = {**shared, **parameters}

    def run(self, jobs: list[Job]) -> Iterator[Finished]:
        submitit = needed("submitit", "hydra/launcher=submitit")
        folder = Path(self.config.hydra.sweep.dir) / ".submitit"
        try:
            executor = submitit.AutoExecutor(folder=folder, cluster=self.cluster)
            executor.update_parameters(**self.parameters)
        except (RuntimeError, ValueError, NameError) as error:
            reason = " ".join(str(error).split())
            raise NsmError(
                f"hydra/launcher=submitit: {reason}", kind="launcher_failed", key="hydra/launcher"
            ) from error
        waiting = list(jobs)
        running: dict[Any, Job] = {}
        while waiting or running:
            free = len(waiting) if self.parallel is None else self.parallel - len(running)
            some, waiting = waiting[:free], waiting[free:]
            if some:
                submitted = executor.map_array(
                    Resumable(), *zip(*(job.call for job in some), strict=True)
                )
                running.update(zip(submitted, some, strict=True))
            for handle in [handle for handle in running if handle.done()]:
                job = running.pop(handle)
                try:
                    yield job, handle.result()
                except Exception as error:  # whatever ended the process, or a failed submission
                    reason = " ".join(str(error).split())[:200]
                    yield job, f"{_KILLED} ({reason})"
            time.sleep(_POLL)


class Resumable:
    """A job as submitit runs it; one that runs out of time continues from its checkpoint."""

    def __call__(self, settings: dict[str, Any], folder: str, cwd: str) -> str | None:
        return run_in_process(Path(folder), settings, folder, cwd)[1]

    def checkpoint(self, *call: Any) -> Any:
        """The job to be queued again."""
        return importlib.import_module("submitit").helpers.DelayedSubmission(self, *call)


class Ray(SweepLauncher):
    """Jobs on a Ray cluster.

    Args:
        address: of the cluster, or auto; None starts a local Ray for the sweep.
        cpus_per_job, gpus_per_job: of each job.
        init: further parameters of ``ray.init``.
    """

    def __init__(
        self, address: str | None, cpus_per_job: float, gpus_per_job: float, init: dict[str, Any]
    ) -> None:
        self.address, self.init = address, init
        self.share = {"num_cpus": cpus_per_job, "num_gpus": gpus_per_job}

    def run(self, jobs: list[Job]) -> Iterator[Finished]:
        if not jobs:
            return
        ray = needed("ray", "hydra/launcher=ray")
        try:
            ray.init(**{**_RAY, "address": self.address, **self.init})
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise NsmError(
                f"hydra/launcher=ray: {reason}", kind="launcher_failed", key="hydra/launcher"
            ) from error
        try:
            # a process for each job, which leaves nothing behind for the next
            remote = ray.remote(max_calls=1, max_retries=0, **self.share)(run_in_process)
            running = {remote.remote(job.folder, *job.call): job for job in jobs}
            while running:
                ended, _ = ray.wait(list(running))
                for handle in ended:
                    job = running.pop(handle)
                    try:
                        yield job, ray.get(handle)[1]
                    except ray.exceptions.RayError as error:
                        yield job, f"{_KILLED} ({type(error).__name__})"
        finally:
            ray.shutdown()


_RAY = {"include_dashboard": False, "log_to_driver": False, "logging_level": "warning"}


def run_in_process(
    place: Path, settings: dict[str, Any], folder: str, cwd: str
) -> tuple[Path, str | None]:
    """Run a job in its own process; give its first argument back with why it failed, or None."""
    with loading_libraries(frozen=True):
        from nsm.pipeline.sweep_jobs import run_job

    return place, run_job(settings, folder, cwd, log=True)


def _label(outcome: Outcome) -> str:
    return " ".join(outcome.overrides) or outcome.folder.name


def _returned(outcome: Outcome) -> JobReturn:
    value = JobReturn(overrides=outcome.overrides, status=JobStatus.COMPLETED)
    value.return_value = outcome
    return value
