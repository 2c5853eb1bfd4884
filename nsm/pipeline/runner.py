"""One runner for all tasks: prepare, train, certify, measure, save."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.text import Text

from nsm.errors import NsmError
from nsm.instantiation import made
from nsm.pipeline.certification import certified
from nsm.pipeline.checkpoints import CHECKPOINT_FILE
from nsm.pipeline.folder_lock import folder_lock
from nsm.pipeline.process_state import process_state
from nsm.pipeline.task import Given, Task
from nsm.pipeline.training import (
    CONFIG_FILE,
    Run,
    check_device,
    interrupted,
    stored_config,
    trained,
)
from nsm.results import atomic_write
from nsm.results.callbacks import Pictures
from nsm.results.divergence_guard import guard_of
from nsm.results.files import as_json
from nsm.results.loggers import check_packages, log_figures, loggers_of
from nsm.results.render import axis_of, upright
from nsm.run_directories import is_temporary
from nsm.stages import stage
from nsm.tasks.ensemble import Ensemble


def run(config: DictConfig, folder: Path) -> None:
    """Run the task of a configuration in a folder, where no other run may be at work.

    With ``resume`` set, the folder's own configuration takes its place, and the training goes on
    from its checkpoint.

    Raises:
        NsmError: bad input of any kind, or another process at work in the folder.
    """
    with folder_lock(folder):
        resuming = config.resume is not None
        if resuming:
            trust = list(config.trust)  # what the stored configuration trusts does not count
            config = stored_config(folder, trust)
            config.trust = trust
        run_task(config, folder, resuming=resuming)


def run_task(
    config: DictConfig,
    folder: Path,
    given: Given | None = None,
    *,
    resuming: bool = False,
    quiet: bool = False,
) -> Any:
    """Run the task that ``config.task`` names, and leave all results in the folder.

    The caller's process (random states, threads, environment, ...) stays as it was.

    Args:
        config: as :func:`nsm.config.compose_config` gives it.
        folder: the run folder, which the caller holds.
        given: inputs, instead of those that the configuration names.
        resuming: go on from the folder's checkpoint.
        quiet: print nothing.

    Returns:
        The task's result.

    Raises:
        NsmError: an input, setting or run folder that cannot be used.
    """
    started = time.monotonic()
    with process_state(), upright(axis_of(config)):
        console = Console(highlight=False, markup=False, quiet=quiet)
        task = make_task(config, console)
        check_device(config)
        check_packages(config.logger)
        task.folder = folder if config.artefacts else None
        with stage(console, f"{task.name}: reading"):
            task.choose_domain(given or Given())
        task.prepare(given or Given())
        run = Run(config, folder, resuming)
        parts = task.parts()
        return run_parts(task, parts, run, started) if parts else run_prepared(task, run, started)


def make_task(config: DictConfig, console: Console) -> Task:
    """The task that ``config.task`` names, not yet prepared.

    Raises:
        NsmError: it names no task.
    """
    task = made(config.task)
    if not isinstance(task, Task):
        raise NsmError(
            f"setting task._target_: a {type(task).__name__} is no nsm.pipeline.Task",
            kind="wrong_type",
            key="task._target_",
        )
    task.setup(config, console)
    return task


def run_prepared(task: Task, run: Run, started: float) -> Any:
    """Train and finish a prepared task.

    Args:
        task: with its inputs.
        run: of the task.
        started: when the run began, by ``time.monotonic``.
    """
    with stage(task.console, f"{task.title}: network and samples"):
        module, data = built(task), task.build_data()
    trainer = trained([run], data, module, task.console, pictures_of(task), task.title)
    while task.begin_again(module):
        # first this, then the new settings: a run that is killed between does the same again
        (run.folder / CHECKPOINT_FILE).unlink(missing_ok=True)
        module, data = built(task), task.build_data()
        trainer = trained([run], data, module, task.console, pictures_of(task), task.title)
    try:
        return finish(task, run, module, trainer, started, data=data)
    except KeyboardInterrupt as error:
        raise interrupted([run], task.console) from error


def run_parts(task: Task, parts: list[Task], run: Run, started: float) -> Any:
    """Train the parts of a task one by one, each in a folder of its own, and finish the whole.

    Args:
        task: prepared.
        parts: of the task.
        run, started: as for :func:`run_prepared`.
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    atomic_write(run.folder / CONFIG_FILE, OmegaConf.to_yaml(run.config).encode())
    results, steps = [], 0
    for k, part in enumerate(parts):
        begun = time.monotonic()
        own = Run(part.config, run.folder / f"part_{k}", resuming=run.resuming, inner=True)
        results.append(run_prepared(part, own, begun))
        stored = json.loads((own.folder / "metrics.json").read_text(encoding="utf-8"))
        steps += stored["steps"]
    result = task.joined(results)
    task.measure(result)
    task.save(run.folder, result)
    warnings = _shown(task, run, result, started)
    _complete(task, run, result, started, steps, task.figures(result), warnings)
    return result


def built(task: Task) -> Any:
    """The task's module, made with the random state of the seed.

    Raises:
        NsmError: settings that do not fit together.
    """
    pl.seed_everything(task.config.seed, verbose=False)
    try:
        module = task.build()
        module.configure_optimizers()  # settings that do not fit fail before any work
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise NsmError(
            f"setting: {' '.join(str(error).split())}", kind="not_instantiable"
        ) from error
    return module


def pictures_of(task: Task) -> Pictures:
    """The task's pictures, meshes and histograms over the training."""
    settings = task.config.trainer
    return Pictures(
        task.picture_name,
        task.picture,
        settings.log_pictures,
        task.mesh,
        settings.log_meshes,
        settings.log_histograms,
    )


def finish(
    task: Task,
    run: Run,
    module: Any,
    trainer: pl.Trainer,
    started: float,
    *,
    data: pl.LightningDataModule | None = None,
    index: int = 0,
) -> Any:
    """Certify, measure and save the result of a training.

    metrics.json is written last: its presence says that the run is complete.

    Args:
        task, run, module, started: as for :func:`run_prepared`.
        trainer: that has trained it, or several in one batch, of which it is number ``index``.
        data: that it was trained on, for further trainings.
        index: see ``trainer``.
    """
    figures: dict[str, Any] = {}
    if task.certified:
        assert data is not None
        with stage(task.console, f"{task.title}: certificate"):
            result, figures = certified(task, module, data)
    else:
        result = task.make_result(module)
    with stage(task.console, f"{task.title}: figures"):
        task.measure(result)
        task.save(run.folder, result)
    warnings = _shown(task, run, result, started)
    ensemble = trainer.lightning_module
    if isinstance(ensemble, Ensemble):
        figures["batched"] = len(ensemble.each)
    loggers = loggers_of(trainer.loggers, index)
    log_figures(loggers, task.settings, result.metrics, trainer.global_step)
    about = {"preparation": task.surface.quality, "faults": guard_of(trainer)}
    about = {**about, **task.figures(result), **figures}
    _complete(task, run, result, started, trainer.global_step, about, warnings)
    return result


def _shown(task: Task, run: Run, result: Any, started: float) -> Sequence[Text]:
    """Print a result's figures and write its pictures and meshes; the warnings on it."""
    warnings = task.warnings(result)
    _print_figures(task, run, result, warnings, time.monotonic() - started)
    if task.config.artefacts:
        with stage(task.console, f"{task.title}: pictures and meshes"):
            task.write_artefacts(run.folder, result)
    return warnings


def _complete(
    task: Task,
    run: Run,
    result: Any,
    started: float,
    steps: int,
    about: Mapping[str, Any],
    warnings: Sequence[Text],
) -> None:
    """Write metrics.json, with more ``about`` the run, and say where the results are."""
    summary = {
        "surface": task.surface.name,
        "steps": steps,
        "seconds": round(time.monotonic() - started, 2),
        **about,
        "warnings": [warning.plain for warning in warnings],
        "metrics": result.metrics,
    }
    atomic_write(run.folder / "metrics.json", as_json(summary))
    if not is_temporary(run.folder) and not run.inner:
        task.console.print(f"results in {run.folder}", soft_wrap=True)


def _print_figures(
    task: Task, run: Run, result: Any, warnings: Sequence[Text], seconds: float
) -> None:
    """A table and warnings; of a neural surface that a map needs, one line."""
    if run.inner:
        line = task.inner_line(result)
        task.console.print(
            f"{task.surface.name}: {line}, {seconds:.0f} s"
            if line
            else made_line(task.surface.name, result.metrics, seconds),
            soft_wrap=True,
        )
        return
    if task.table is not None:
        task.console.print(task.table(result.metrics))
    for warning in warnings:
        task.console.print(warning, soft_wrap=True)


def made_line(name: str, metrics: Mapping[str, float], seconds: float) -> str:
    """What is said of a neural surface that a map needed, in one line."""
    return (
        f"{name}: neural surface in {seconds:.0f} s, RMS distance {metrics['rms_percent']:.3f} % "
        "of the diagonal"
    )
