"""What all runs share: building a module, training it in its folder, and what is left there."""

from __future__ import annotations

import copy
import logging
import os
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.accelerators import CUDAAccelerator
from pytorch_lightning.callbacks import Callback, LearningRateMonitor
from pytorch_lightning.loggers import Logger
from rich.console import Console
from torch.multiprocessing.spawn import ProcessRaisedException

from nsm.config import PRECISIONS, checked, read_config
from nsm.data import OverfitData
from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.pipeline.processes import Process, shared_steps, take_over, told_by
from nsm.results import atomic_write
from nsm.results.callbacks import AtomicCheckpoint, GradientWatch, Pictures
from nsm.results.divergence_guard import DivergenceGuard, guard_of
from nsm.results.files import as_json, check_stored
from nsm.results.loggers import Distributed, build_loggers, close, log_figures, loggers_of
from nsm.results.progress import TrainingProgress
from nsm.results.throughput import Throughput
from nsm.run_directories import is_passing
from nsm.surfaces.cache import cache_folder
from nsm.tasks.compiling import Compiled
from nsm.tasks.ensemble import Ensemble

CONFIG_FILE = "config.yaml"
CHECKPOINT_FILE = "last.ckpt"


def built(config: DictConfig, make: Callable[[dict[str, Any]], Any]) -> Any:
    """The module that ``make`` makes of the settings, seeded.

    Raises:
        NsmError: settings that do not fit together.
    """
    pl.seed_everything(config.seed, verbose=False)
    try:
        module = make(plain(config))
        module.configure_optimizers()  # settings that do not fit are told before any work
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise NsmError(f"setting: {' '.join(str(error).split())}") from error
    return module


def with_map(settings: dict[str, Any], **network: Any) -> dict[str, Any]:
    """The settings that every task's module takes; ``network`` adds to the map's."""
    groups = {"activation": settings["activation"], "encoding": settings["encoding"]}
    return {
        "map": {**network, **settings["map"], **groups},
        "optimizer": settings["optimizer"],
        "scheduler": settings["scheduler"],
        "max_steps": settings["trainer"]["max_steps"],
    }


def frozen(network: torch.nn.Module) -> Any:
    """A copy of a trained network as results hold it: on the CPU, and no more to be trained."""
    return copy.deepcopy(network).cpu().eval().requires_grad_(False)


def plain(config: DictConfig) -> dict[str, Any]:
    """The configuration as dictionaries and lists."""
    container = OmegaConf.to_container(config)
    assert isinstance(container, dict)
    return container  # type: ignore[return-value]


def stored_config(folder: Path) -> DictConfig:
    """The configuration of a run that goes on.

    Raises:
        NsmError: none is there, or it cannot be used.
    """
    file = folder / CONFIG_FILE
    if not file.is_file():
        raise NsmError(f"resume={folder}: no {CONFIG_FILE} there; give the folder of a run")
    return checked(read_config(file))


def settle_path(config: DictConfig) -> None:
    """Make the path of the group ``surface``, if any, absolute: resuming works from any folder."""
    if config.surface.path is not None:
        config.surface.path = os.path.abspath(config.surface.path)


def configured_surface(config: DictConfig) -> Surface:
    """The surface of the group ``surface``, prepared; NsmError if it cannot be."""
    settle_path(config)
    settings = config.surface
    return Surface.load(
        settings.path if settings.path is not None else settings.name,
        domain=config.domain,
        seam_vertices=settings.seam_vertices,
        parameterization=settings.parameterization,
        cache=settings.cache,
    )


def report_surface(console: Console, surface: Surface) -> None:
    """Print what a prepared surface is and what was done to it."""
    console.print(
        f"{surface.name}: {len(surface.vertices)} vertices, {len(surface.faces)} faces on the "
        f"{surface.domain}, median symmetric Dirichlet "
        f"{surface.quality['median_symmetric_dirichlet']:.2f}",
        soft_wrap=True,
    )
    for line in surface.log:
        console.print(f"  {line}", soft_wrap=True)


def say_where(console: Console, folder: Path) -> None:
    """Print where a run's results are, if they stay there."""
    if not is_passing(folder):
        console.print(f"results in {folder}", soft_wrap=True)


def train(
    config: DictConfig,
    folder: Path,
    surface: Surface,
    module: pl.LightningModule,
    console: Console,
    pictures: Pictures,
    *,
    resuming: bool,
    title: str | None = None,
) -> pl.Trainer:
    """:func:`fitted` on samples of one surface, whose name is the title by default."""
    data = OverfitData(surface, **plain(config)["data"], seed=config.seed)
    words = f"{config.task.name} {title or surface.name}"
    return fitted(config, folder, data, module, console, pictures, words, resuming=resuming)


def fitted(
    config: DictConfig,
    folder: Path,
    data: pl.LightningDataModule,
    module: Any,
    console: Console,
    pictures: Pictures | None,
    title: str,
    *,
    resuming: bool,
) -> pl.Trainer:
    """Train a module in its run folder; KeyboardInterrupt if the user stops it."""
    return trained([Run(config, folder, resuming)], data, module, console, pictures, title)


@dataclass(frozen=True)
class Run:
    """A training to be made.

    Attributes:
        config: as :func:`nsm.config.compose_config` gives it.
        folder: the run folder.
        resuming: go on from the folder's checkpoint, if there is one.
    """

    config: DictConfig
    folder: Path
    resuming: bool

    @property
    def checkpoint(self) -> Path | None:
        """What the training goes on from; None: from its beginning, as one that was killed before
        its first checkpoint does."""
        file = self.folder / CHECKPOINT_FILE
        return file if self.resuming and file.is_file() else None

    @property
    def stage(self) -> tuple[int, int] | None:
        """How far it is, which trainings in one batch have in common: steps, and parts that batches
        are evaluated in. None: it has to go on alone, since it is at its end, has had faults of its
        own, or has a checkpoint that cannot be read."""
        if self.checkpoint is None:
            return 0, 1
        try:
            state = stored_state(self.checkpoint)
            if state["callbacks"]["DivergenceGuard"]["rollbacks"]:
                return None
            stage = state["global_step"], int(state["nsm_parts"])
        except (NsmError, KeyError, TypeError, ValueError):
            return None
        return stage if stage[0] < self.config.trainer.max_steps else None

    def loggers(self, first_step: int) -> list[Logger]:
        """Those of the configuration, for a training that starts at a step."""
        settings = plain(self.config)
        logged = settings["logger"]
        places = {key: logged[key] for key in ("project", "uri", "every")}
        return build_loggers(
            logged["kinds"], self.folder, settings, first_step=first_step, **places
        )


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
        runs: one, or those of a :class:`nsm.tasks.ensemble.Several`, whose checkpoints are of one
            step; their settings are the same in what concerns the training as a whole.
        data, module, console: the samples, what is trained, and where to print.
        pictures: for the logs, if any.
        title: what is trained, in words.

    Raises:
        KeyboardInterrupt: the user stops it.
        EnsembleSplit: several trainings cannot go on in one batch.
    """
    config, folder = runs[0].config, runs[0].folder
    settings = config.trainer
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    faults = DivergenceGuard(console)
    callbacks: list[Callback] = [
        faults,
        GradientWatch(config.logger.every, settings.stop_gradient_norm, settings.stop_window),
        AtomicCheckpoint(*(run.folder / CHECKPOINT_FILE for run in runs)),
    ]
    if settings.progress:
        shown = (module.progress_figure, module.progress_form)
        callbacks.append(TrainingProgress(console, title, *shown))
    if config.logger.kinds:
        callbacks += [LearningRateMonitor(), Throughput(config.logger.every)]
        callbacks += [pictures] if pictures else []
    module.log_every = config.logger.every
    if settings.compile:
        module.compiled = Compiled(lambda line: console.print(line, soft_wrap=True))
    quiet_lightning()
    accelerator = accelerator_of(config)
    several = settings.devices > 1
    try:
        trainer = pl.Trainer(
            accelerator=accelerator,
            devices=settings.devices,
            strategy=shared_steps() if several else "auto",
            use_distributed_sampler=False,
            max_steps=settings.max_steps,
            max_epochs=-1,
            gradient_clip_val=settings.gradient_clip,
            logger=False,
            callbacks=callbacks,
            log_every_n_steps=config.logger.every,
            num_sanity_val_steps=0,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
        )
    except Exception as error:  # Lightning's own exceptions for hardware that is not there
        reason = " ".join(str(error).split())
        raise NsmError(
            f"setting trainer.accelerator={accelerator}, trainer.devices={settings.devices}: "
            f"{reason}"
        ) from error
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
        if len(runs) == 1 or not config.logger.kinds:
            return runs[0].loggers(step)
        return [Distributed([run.loggers(step) for run in runs])]

    if several:
        trainer.callbacks.insert(0, Process(console, lambda: loggers(first_step)))  # type: ignore[attr-defined]
    else:
        trainer.loggers = loggers(first_step)
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(PRECISIONS[settings.precision])
    try:
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except ProcessRaisedException as error:
        raise told_by(error) from error
    except SystemExit:  # what Lightning makes of an interrupt
        if not trainer.interrupted:
            raise
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError) as error:
        if checkpoint is None or faults.begun:
            raise
        raise _no_checkpoint(checkpoint) from error  # of another network, or forged
    finally:
        # results are measured in full precision
        torch.set_float32_matmul_precision(before)
        if trainer.state.status != "finished":
            close(trainer.loggers, "failed")
    if trainer.interrupted:
        how = f"; go on with: nsm resume={folder}"
        if len(runs) > 1 or cache_folder() in folder.parents:  # of a sweep, or for a map
            how = "; the same command goes on"
        console.print(f"interrupted{'' if is_passing(folder) else how}", soft_wrap=True)
        raise KeyboardInterrupt
    if several:
        take_over(trainer, data, folder / CHECKPOINT_FILE)
        trainer.loggers = loggers(trainer.global_step + 1)
    return trainer


def accelerator_of(config: DictConfig) -> str:
    """The hardware that a training runs on, ``gpu`` or ``cpu``."""
    chosen: str = config.trainer.accelerator
    if chosen == "auto":  # Lightning would choose Apple's GPU, which has no float64
        # unlike torch's, its question for a GPU leaves the process fit for a fork
        return "gpu" if CUDAAccelerator.is_available() else "cpu"
    return chosen


def quiet_lightning() -> None:
    """Leave out Lightning's remarks on data loaders and hardware: they do not concern samples that
    are made on the device."""
    for name in ("pytorch_lightning", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="pytorch_lightning")
    warnings.filterwarnings("ignore", module="lightning_fabric")


def stored_state(checkpoint: Path) -> dict[str, Any]:
    """What a checkpoint holds; its ``global_step`` is a number.

    Raises:
        NsmError: a file that is damaged, foreign, or that would call or swell.
    """
    try:
        check_stored(checkpoint)
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True, map_location="cpu")
        return {**state, "global_step": int(state["global_step"])}
    except Exception as error:  # whatever a damaged or foreign file raises
        raise _no_checkpoint(checkpoint) from error


def _no_checkpoint(file: Path) -> NsmError:
    return NsmError(f"{file}: damaged, or not a checkpoint of this run; delete it to start again")


def write_figures(
    config: DictConfig,
    folder: Path,
    surface: Surface,
    trainer: pl.Trainer,
    started: float,
    figures: dict[str, Any],
    index: int = 0,
) -> None:
    """Put the figures into the logs, and write metrics.json, last of all: its presence says that
    the run is complete.

    Args:
        config, folder, surface: of the run.
        trainer: that has trained it, or several in one batch, of which it is number ``index``.
        started: when the run began, by ``time.monotonic``.
        figures: ``metrics``, and what else is to be in the file.
        index: see ``trainer``.
    """
    loggers = loggers_of(trainer.loggers, index)
    log_figures(loggers, plain(config), figures["metrics"], trainer.global_step)
    words = {
        "surface": surface.name,
        "steps": trainer.global_step,
        "seconds": round(time.monotonic() - started, 2),
        "preparation": surface.quality,
        "faults": guard_of(trainer),
        **figures,
    }
    atomic_write(folder / "metrics.json", as_json(words))
