"""What accompanies a training: checkpoints, the stopping rule, pictures over time."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback
from torch.optim import Optimizer

from nsm.errors import NsmError
from nsm.results.files import flush_folder
from nsm.results.loggers import log_picture, loggers_of, takes_pictures
from nsm.tasks.ensemble import Ensemble, members


class AtomicCheckpoint(Callback):
    """Keep the last state of the training after each epoch, whole at any moment.

    Args:
        paths: the checkpoint file, or that of each of several trainings in one batch; written
            beside it first, then moved into its place.
    """

    def __init__(self, *paths: Path) -> None:
        self.paths = paths

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        # resumed at the end of an epoch, Lightning counts one step too many for the logs; it has no
        # public way to set the number, and a test fails if this one is gone
        trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        for index, path in enumerate(self.paths):
            if isinstance(pl_module, Ensemble):
                pl_module.shown = index
            self._save(trainer, path)

    def _save(self, trainer: pl.Trainer, path: Path) -> None:
        temporary = path.with_suffix(".tmp")
        try:
            trainer.save_checkpoint(temporary)
            if not trainer.is_global_zero:
                return
            with temporary.open("rb") as stream:
                os.fsync(stream.fileno())
            os.replace(temporary, path)
            flush_folder(path.parent)
        except (OSError, RuntimeError) as error:  # torch has RuntimeError for a full disk
            temporary.unlink(missing_ok=True)
            reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:120]
            raise NsmError(
                f"{path}: the checkpoint of step {trainer.global_step} cannot be written "
                f"({reason}); the one before, if any, is whole. Free some space, then go on with: "
                f"nsm resume={path.parent}",
                kind="unwritable_file",
                key=str(path),
            ) from error


class GradientWatch(Callback):
    """Log the gradient's norm, of each training in the batch; a single training can stop by it.

    Args:
        every: steps between two values in the log.
        stop_norm: stop when the mean norm of the last ``window`` steps is below, with warm
            restarts only where a wave ends; None: never.
        window: the number of steps that are averaged.
        summed: take the norm of the loss summed over the batch: that of the mean, which is trained
            and logged, times the number of samples.
    """

    def __init__(
        self, every: int, stop_norm: float | None, window: int, *, summed: bool = False
    ) -> None:
        self.every, self.stop_norm, self.summed = every, stop_norm, summed
        self.recent: deque[float] = deque(maxlen=window)

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Optimizer
    ) -> None:
        logging = (trainer.global_step + 1) % self.every == 0  # the steps that Lightning keeps
        if not logging and self.stop_norm is None:
            return
        for end, module in members(pl_module).items():
            gradients = [p.grad for p in module.parameters() if p.grad is not None]
            if not gradients:  # taken back, as not finite (see DivergenceGuard)
                return
            norm = float(torch.nn.utils.get_total_norm(gradients))
            self.recent.append(norm)
            if logging:
                pl_module.log(f"train/gradient_norm{end}", norm)

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        full = len(self.recent) == self.recent.maxlen
        if self.stop_norm is not None and full and _may_stop(trainer):
            # each of several processes has its part of the batch
            samples = _samples(batch) * trainer.world_size if self.summed else 1
            if samples * sum(self.recent) / len(self.recent) < self.stop_norm:
                trainer.should_stop = True

    def state_dict(self) -> dict[str, Any]:
        return {"recent": list(self.recent)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.recent.extend(state_dict["recent"])


def _samples(batch: Any) -> int:
    """How many samples a batch has: a tensor (N, ...), or a tuple of such."""
    return len(batch if isinstance(batch, torch.Tensor) else batch[0])


def _may_stop(trainer: pl.Trainer) -> bool:
    """Whether no schedule of the training is within a wave, where its rate is still high."""
    schedulers = [config.scheduler for config in trainer.lr_scheduler_configs]
    waves = [s.wave_ends for s in schedulers if hasattr(s, "wave_ends")]
    return all(ends(trainer.global_step) for ends in waves)


class Pictures(Callback):
    """Put pictures into the logs, evenly spread over the run.

    Args:
        name: of the pictures.
        draw: from the module, or that of each of several trainings in one batch, to a picture
            (H, W, 3) uint8, or None.
        count: the number of pictures in all.
    """

    def __init__(self, name: str, draw: Callable[[Any], np.ndarray | None], count: int) -> None:
        self.name, self.draw, self.count, self.taken = name, draw, count, 0

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if not trainer.is_global_zero or not takes_pictures(trainer.loggers):
            return
        share = trainer.global_step / max(1, trainer.max_steps)
        due = int(share * self.count)
        if due <= self.taken:
            return
        self.taken = due
        for index, module in enumerate(members(pl_module).values()):
            picture = self.draw(module)
            if picture is not None:
                loggers = loggers_of(trainer.loggers, index)
                log_picture(loggers, self.name, picture, trainer.global_step)

    def state_dict(self) -> dict[str, Any]:
        return {"taken": self.taken}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.taken = state_dict["taken"]
