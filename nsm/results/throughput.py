"""How fast a training runs."""

from __future__ import annotations

import time
from typing import Any

import pytorch_lightning as pl
from pytorch_lightning.callbacks import Callback


class Throughput(Callback):
    """Log ``train/samples_per_second``, the mean since the last value in the log.

    Validation, pictures and checkpoints, which come between two steps, do not count.

    Args:
        every: steps between two values.
    """

    def __init__(self, every: int) -> None:
        self.every, self.samples, self.seconds, self.started = every, 0, 0.0, 0.0

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        self.started = time.perf_counter()

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        points = batch[0] if isinstance(batch, tuple) else batch
        of_process = points.shape[-2]  # of several trainings in one batch, what each has
        self.samples += of_process * trainer.world_size
        due = trainer.global_step % self.every == 0
        if due:
            # a GPU still works at what was asked of it: the value is the time until it is done
            float(outputs["loss"])
        self.seconds += time.perf_counter() - self.started
        if due:
            pl_module.log("train/samples_per_second", self.samples / max(self.seconds, 1e-9))
            self.samples, self.seconds = 0, 0.0
