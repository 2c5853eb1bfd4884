"""One training in its run folder, or several in one batch, each in its own."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.accelerators import CUDAAccelerator, MPSAccelerator
from pytorch_lightning.callbacks import Callback, LearningRateMonitor
from pytorch_lightning.loggers import Logger
from rich.console import Console
from torch.multiprocessing.spawn import ProcessRaisedException

from nsm.config import read_config
from nsm.config_validation import checked
from nsm.errors import NsmError
from nsm.instantiation import check_trusted, made
from nsm.pipeline.checkpoints import CHECKPOINT_FILE, not_a_checkpoint, stored_state
from nsm.pipeline.process_state import matmul_precision, quiet_lightning
from nsm.pipeline.processes import Process, raised_by, shared_steps, take_over
from nsm.results import atomic_write
from nsm.results.callbacks import AtomicCheckpoint, GradientWatch, Pictures
from nsm.results.devices import NO_GPU, count_of_gpus
from nsm.results.divergence_guard import DivergenceGuard
from nsm.results.evolution import EvolutionStrip
from nsm.results.loggers import Distributed, build_loggers, close
from nsm.results.progress import TrainingProgress
from nsm.results.throughput import Throughput
from nsm.run_directories import is_temporary
from nsm.settings import PRECISIONS
from nsm.tasks.compiling import Compiled
from nsm.tasks.ensemble import Ensemble
from nsm.wording import number_of

CONFIG_FILE = "config.yaml"


def plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as dictionaries and lists."""
    container = OmegaConf.to_container(config)
    assert isinstance(container, dict)
    return container  # type: ignore[return-value]


def stored_config(folder: Path, trust: Sequence[str] = ()) -> DictConfig:
    """The configuration of a run that goes on.

    Args:
        folder: of the run.
        trust: modules whose classes it may name, beside those of nsm and torch.

    Raises:
        NsmError: there is none, it cannot be used, or it names classes that are not trusted.
    """
    file = folder / CONFIG_FILE
    if not file.is_file():
        raise NsmError(
            f"resume={folder}: no {CONFIG_FILE} there; give the folder of a run",
            kind="missing_file",
            key=str(file),
        )
    stored = read_config(file)
    try:
        check_trusted(plain(stored), trust)
    except NsmError as error:
        raise NsmError(f"{file}: {error}", kind=error.kind, key=error.key) from error
    return checked(stored)


@dataclass(frozen=True)
class Run:
    """A training to be made.

    Attributes:
        config: as :func:`nsm.config.compose_config` gives it.
        folder: the run folder.
        resuming: go on from the folder's checkpoint, if there is one.
        inner: it makes a neural surface that a map needs.
    """

    config: DictConfig
    folder: Path
    resuming: bool = False
    inner: bool = False

    @property
    def checkpoint(self) -> Path | None:
        """What the training goes on from; None: it starts, or was killed before its first
        checkpoint."""
        file = self.folder / CHECKPOINT_FILE
        return file if self.resuming and file.is_file() else None

    @property
    def stage(self) -> tuple[int, int] | None:
        """Steps made and parts of a batch, which trainings in one batch have in common.

        None: it has to go on alone, because it has made all steps, has been rolled back, or has a
        checkpoint that cannot be read.
        """
        if self.checkpoint is None:
            return 0, 1
        try:
            state = stored_state(self.checkpoint)
            if state["callbacks"]["DivergenceGuard"]["rollbacks"]:
                return None
            stage = state["global_step"], int(state["microbatches"])
        except (NsmError, KeyError, TypeError, ValueError):
            return None
        return stage if stage[0] < self.config.trainer.max_steps else None

    def loggers(self, first_step: int) -> list[Logger]:
        """Those of the configuration, for a training that starts at a step."""
        return build_loggers(plain(self.config), self.folder, first_step)


def trained(
    runs: Sequence[Run],
    data: pl.LightningDataModule,
    module: Any,
    console: Console,
    pictures: Pictures | None,
    title: str,
) -> pl.Trainer:
    """Train a module in its run folder, or that of several trainings in one batch, each in its own.

    Args:
        runs: one, or those of a :class:`nsm.tasks.ensemble.Ensemble`, whose checkpoints are of one
            step; their settings are the same in what concerns the training as a whole.
        data, module, console: the samples, what is trained, and where to print.
        pictures: for the logs, if any.
        title: what is trained, for the progress bar.

    Raises:
        KeyboardInterrupt: the user stops it.
        EnsembleSplit: several trainings cannot go on in one batch.
        NsmError: a setting, checkpoint or device that cannot be used; a loss that stays infinite.
    """
    config, folder = runs[0].config, runs[0].folder
    settings = config.trainer
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    guard = DivergenceGuard(console)
    callbacks: list[Callback] = [
        guard,
        GradientWatch.of(settings),
        AtomicCheckpoint(*(run.folder / CHECKPOINT_FILE for run in runs)),
        *_own_callbacks(config),
    ]
    if settings.progress:
        callbacks.append(
            TrainingProgress(
                console,
                title,
                module.progress_figure,
                module.progress_form,
                transient=runs[0].inner,
            )
        )
    if config.logger:
        callbacks += [LearningRateMonitor(), Throughput(settings.log_every)]
        callbacks += [pictures] if pictures else []
    if pictures and config.artefacts:
        folders = [run.folder for run in runs]
        callbacks.append(EvolutionStrip(pictures.draw, settings.log_pictures, folders))
    module.log_every = settings.log_every
    if settings.compile:
        module.compiled = Compiled(lambda line: console.print(line, soft_wrap=True))
    several = settings.devices > 1 and settings.max_steps > 0
    trainer = lightning_trainer(
        config,
        callbacks,
        devices=settings.devices if several else 1,
        max_steps=settings.max_steps,
        strategy=shared_steps() if several else "auto",
        log_every_n_steps=settings.log_every,
    )
    for run in runs:
        run.folder.mkdir(parents=True, exist_ok=True)
        atomic_write(run.folder / CONFIG_FILE, OmegaConf.to_yaml(run.config).encode())
    states = [stored_state(run.checkpoint) for run in runs if run.checkpoint]
    first_step = states[0]["global_step"] if states else 0
    checkpoint = runs[0].checkpoint if first_step else None
    if isinstance(module, Ensemble):
        module.stored = states
    del states

    def loggers(step: int) -> list[Logger]:
        if len(runs) == 1 or not config.logger:
            return runs[0].loggers(step)
        return [Distributed([run.loggers(step) for run in runs])]

    if several:
        trainer.callbacks.insert(0, Process(console, lambda: loggers(first_step)))  # type: ignore[attr-defined]
    else:
        trainer.loggers = loggers(first_step)
    try:
        with matmul_precision(PRECISIONS[settings.precision]):
            trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except ProcessRaisedException as error:
        raise raised_by(error) from error
    except SystemExit:  # what Lightning makes of an interrupt
        if not trainer.interrupted:
            raise
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError) as error:
        if checkpoint is None or guard.begun:
            raise
        raise not_a_checkpoint(checkpoint) from error  # of another network, or forged
    finally:
        if trainer.state.status != "finished":
            close(trainer.loggers, "failed")
    if trainer.interrupted:
        raise interrupted(runs, console)
    if several:
        take_over(trainer, folder / CHECKPOINT_FILE)
        trainer.loggers = loggers(trainer.global_step + 1)
    return trainer


def interrupted(runs: Sequence[Run], console: Console) -> KeyboardInterrupt:
    """Say how an interrupted training, or what follows it, goes on."""
    folder = runs[0].folder
    how = f"; go on with: nsm {shlex.quote(f'resume={folder}')}"
    if len(runs) > 1 or runs[0].inner:  # of a sweep, or for a map
        how = "; the same command goes on"
    console.print(f"interrupted{'' if is_temporary(folder) else how}", soft_wrap=True)
    return KeyboardInterrupt("told")


def lightning_trainer(
    config: DictConfig, callbacks: list[Callback], **arguments: Any
) -> pl.Trainer:
    """Lightning's trainer with the configured hardware, and none of its own output.

    Raises:
        NsmError: hardware that is not there.
    """
    quiet_lightning()
    settings, accelerator = config.trainer, accelerator_of(config)
    try:
        return pl.Trainer(
            accelerator=accelerator,
            use_distributed_sampler=False,
            max_epochs=-1,
            gradient_clip_val=settings.gradient_clip,
            logger=False,
            callbacks=callbacks,
            num_sanity_val_steps=0,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
            **arguments,
        )
    except Exception as error:  # Lightning's own exceptions for hardware that is not there
        reason = " ".join(str(error).split())
        raise NsmError(
            f"setting trainer.accelerator={accelerator}, trainer.devices={settings.devices}: "
            f"{reason}",
            kind="no_such_device",
            key="trainer.accelerator",
        ) from error


def check_device(config: DictConfig) -> None:
    """Check that the chosen hardware is there, before anything takes time.

    Raises:
        NsmError: ``no_such_device``.
    """
    if accelerator_of(config) != "gpu" or MPSAccelerator.is_available():
        return
    count = count_of_gpus()
    if count < config.trainer.devices:
        some = f"torch finds {number_of(count, 'GPU')}; give trainer.devices={count} or fewer"
        raise NsmError(
            f"device=cuda (trainer.accelerator=gpu): {some if count else NO_GPU}",
            kind="no_such_device",
            key="trainer.accelerator",
        )


def accelerator_of(config: DictConfig) -> str:
    """The hardware that a training runs on, ``gpu`` or ``cpu``."""
    chosen: str = config.trainer.accelerator
    if chosen == "auto":  # Lightning would choose Apple's GPU, which has no float64
        # unlike torch's, its question for a GPU leaves the process fit for a fork
        return "gpu" if CUDAAccelerator.is_available() else "cpu"
    return chosen


def _own_callbacks(config: DictConfig) -> list[Callback]:
    """The user's own, of the group ``callbacks``."""
    result = []
    for name, settings in plain(config)["callbacks"].items():
        callback = made(settings)
        if not isinstance(callback, Callback):
            raise NsmError(
                f"setting callbacks.{name}: a {type(callback).__name__} is no Lightning callback",
                kind="wrong_type",
                key=f"callbacks.{name}",
            )
        result.append(callback)
    return result
