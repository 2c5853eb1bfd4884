"""A progress bar with time left, loss and current error; where there is no terminal, a stage."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Any

import pytorch_lightning as pl
from pytorch_lightning.callbacks import Callback
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from nsm.stages import at, showing, stage

_EVERY = 0.2  # seconds between two updates


class TrainingProgress(Callback):
    """Show how far the training is.

    Args:
        console: where to write.
        title: what is being trained.
        key, form: the logged figure that is shown as the current error, and how.
        transient: leave no bar behind.
    """

    def __init__(
        self,
        console: Console,
        title: str,
        key: str = "val/rms_percent",
        form: str = "error {:.3f} %",
        *,
        transient: bool = False,
    ) -> None:
        self.console, self.title, self.key, self.form = console, title, key, form
        self.transient = transient
        self.bar: Progress | None = None
        self.task: TaskID | None = None
        self.shown = 0.0
        self.figures = ""
        self.within: ExitStack | None = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.shown = time.monotonic()
        if not self.console.is_terminal or showing():
            self.within = ExitStack()
            self.within.enter_context(stage(self.console, self.title))
            at("step", trainer.global_step, trainer.max_steps)
            return
        self.bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[figures]}"),
            console=self.console,
            transient=self.transient,
        )
        self.bar.start()
        self.task = self.bar.add_task(
            self.title, total=trainer.max_steps, completed=trainer.global_step, figures=""
        )

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        now = time.monotonic()
        step = trainer.global_step
        if now - self.shown >= _EVERY:
            self.shown = now
            self.figures = f"loss {float(outputs['loss']):.2e}"
            error = trainer.callback_metrics.get(self.key)
            if error is not None:
                self.figures += "  " + self.form.format(float(error))
            if self.bar is not None and self.task is not None:
                self.bar.update(self.task, completed=step, figures=self.figures)
        if self.within is not None:
            early = getattr(pl_module, "may_end_early", False)
            at("step", step, trainer.max_steps, self.figures, early)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if self.bar is not None and self.task is not None:
            self.bar.update(self.task, completed=trainer.global_step)
        self._stop()
        if trainer.should_stop and trainer.global_step < trainer.max_steps and not self.transient:
            self.console.print(
                f"{self.title}: settled after {trainer.global_step} steps, of "
                f"{trainer.max_steps} at most",
                soft_wrap=True,
            )

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        self._stop()

    def _stop(self) -> None:
        if self.within is not None:
            self.within.close()
            self.within = None
        if self.bar is not None:
            self.bar.stop()
            self.bar = None
