"""Trainings of the benchmarks: on one thread of the CPU, measured by CPU time, unless said."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from omegaconf import DictConfig
from pytorch_lightning.callbacks import Callback
from rich.console import Console

from nsm.data import SurfaceData
from nsm.domains import Surface
from nsm.instantiation import made
from nsm.pipeline import built, make_task
from nsm.tasks import Overfit

MESHES = {
    "cow": "cow.obj",
    "bunny": "stanford-bunny.obj",
    "shrec07-384": "shrec07-384.off",
    "igea": "igea.ply",
}


def surface_of(name: str, meshes: Path | None, **settings: Any) -> Surface:
    """The prepared surface of a mesh in a folder, or of the catalogue if there is no folder."""
    return Surface.load(meshes / MESHES[name] if meshes else name, **settings)


# in results of surfaces, beside those of maps, which have flips before and after repair and a start
NO_MAP = "none to count: a neural surface has no triangles that flip, and nothing is repaired"


class Clock(Callback):
    """Stop after a budget of time; call back at marks, whose time does not count.

    Args:
        marks: seconds; the last is the budget.
        at_mark: takes the module, the seconds and the steps.
        seconds: the time now; that of the CPU by default.
    """

    def __init__(
        self,
        marks: Sequence[float],
        at_mark: Callable[[Any, float, int], None],
        seconds: Callable[[], float] = time.process_time,
    ) -> None:
        self.marks, self.at_mark, self.seconds = list(marks), at_mark, seconds
        self.budget, self.aside = marks[-1], 0.0
        self.start = seconds()

    @property
    def spent(self) -> float:
        """Seconds since the clock was created, without those at marks."""
        return self.seconds() - self.start - self.aside

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any
    ) -> None:
        spent = self.spent
        while self.marks and spent >= self.marks[0]:
            before = self.seconds()
            self.at_mark(pl_module, self.marks.pop(0), trainer.global_step)
            self.aside += self.seconds() - before
        trainer.should_stop = trainer.should_stop or not self.marks


class OnTheClock(Clock):
    """A clock by which a schedule with an end ends with the budget."""

    @property
    def progress(self) -> float:
        """The share of the budget that has been spent, in [0, 1]."""
        return min(1.0, self.spent / self.budget)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        def by_time(factor: Any) -> Any:
            return lambda _: factor(pl_module.hparams["max_steps"] * self.progress)

        if pl_module.hparams["scheduler"]["_target_"].endswith(".Cosine"):
            for configured in trainer.lr_scheduler_configs:
                scheduler: Any = configured.scheduler
                scheduler.lr_lambdas = [by_time(factor) for factor in scheduler.lr_lambdas]


def module_of(config: DictConfig, *inputs: Any) -> Any:
    """The module that a task trains, for prepared inputs: those of the task's method ``use``."""
    task: Any = make_task(config, Console(quiet=True))
    task.use(*inputs)
    return built(task)


def samples_of(
    config: DictConfig, surface: Surface, kind: type[SurfaceData] = SurfaceData
) -> SurfaceData:
    """The data module of a configuration, or one of another class with its settings."""
    settings = {key: value for key, value in config.data.items() if key != "_target_"}
    return kind(surface, made(config.sampler), **settings, seed=config.seed)


def train(
    config: DictConfig,
    surface: Surface,
    callbacks: list[Callback],
    max_steps: int | None = None,
    exchanged: Callable[[Overfit], Overfit] = lambda module: module,
    inputs: Sequence[Any] | None = None,
    accelerator: str = "cpu",
) -> tuple[pl.Trainer, Any, float]:
    """Train a network at samples of a surface; returns the trainer, the module and the CPU seconds.

    Args:
        config: settings of the run.
        surface: the prepared surface.
        callbacks: of Lightning.
        max_steps: length of the training, -1 without limit; that of its schedule by default.
        exchanged: from nsm's module to the one that is trained.
        inputs: what the method ``use`` of the task takes; by default the surface.
        accelerator: Lightning's word for the hardware.
    """
    start = time.process_time()
    module = exchanged(module_of(config, *([surface] if inputs is None else inputs)))
    data = samples_of(config, surface, getattr(module, "samples", SurfaceData))
    with tempfile.TemporaryDirectory() as folder:
        trainer = pl.Trainer(
            accelerator=accelerator,
            devices=1,
            max_steps=config.trainer.max_steps if max_steps is None else max_steps,
            max_epochs=-1,
            callbacks=callbacks,
            gradient_clip_val=config.trainer.gradient_clip,
            logger=False,
            default_root_dir=folder,
            limit_val_batches=0,
            num_sanity_val_steps=0,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
        )
        trainer.fit(module, datamodule=data)
    return trainer, module, time.process_time() - start
