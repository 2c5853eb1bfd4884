"""What accompanies a training: checkpoints, the stopping rule, pictures over time."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback
from pytorch_lightning.loggers import Logger
from torch.optim import Optimizer

from nsm.errors import NsmError
from nsm.results.files import flush_folder
from nsm.results.loggers import event_files, log_picture, loggers_of, takes_pictures
from nsm.results.meshes import ColouredMesh
from nsm.settings import TrainerSettings
from nsm.tasks.ensemble import Ensemble, members

_MOST_VERTICES = 100_000  # of a mesh in the logs: TensorBoard's page loads all of them


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

    @classmethod
    def of(cls, settings: TrainerSettings) -> GradientWatch:
        """As the settings ``trainer`` want it."""
        return cls(
            settings.log_every,
            settings.stop_gradient_norm,
            settings.stop_window,
            summed=settings.stop_norm_of == "sum",
        )

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
    """Put what is seen of a training into the logs, evenly from its start to its end.

    Args:
        name: of the pictures and meshes.
        draw: from the module, or that of each of several trainings in one batch, to a picture
            (H, W, 3) uint8, or None.
        count: the number of pictures in all; 1: the last alone.
        mesh: from the module to a mesh, or None.
        meshes: the number of meshes, as of pictures, for TensorBoard.
        histograms: of the weights and their gradients, as of pictures, for TensorBoard.
    """

    def __init__(
        self,
        name: str,
        draw: Callable[[Any], np.ndarray | None],
        count: int,
        mesh: Callable[[Any], ColouredMesh | None] = lambda module: None,
        meshes: int = 0,
        histograms: int = 0,
    ) -> None:
        self.name, self.draw, self.mesh = name, draw, mesh
        # what is logged, how often in all, and how many of it have been
        self.kinds = {
            "pictures": (self._picture, count),
            "meshes": (self._mesh, meshes),
            "weights": (self._weights, histograms),
            "gradients": (self._gradients, histograms),
        }
        self.taken = dict.fromkeys(self.kinds, 0)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.global_step == 0:
            self._take(trainer, pl_module, 0.0)

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        # Lightning drops the gradients before a validation
        self._take(trainer, pl_module, trainer.global_step / trainer.max_steps, "gradients")

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.global_step < trainer.max_steps:  # the last are those of the end
            self._take(trainer, pl_module, trainer.global_step / trainer.max_steps)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.global_step and not trainer.interrupted:
            self._take(trainer, pl_module, 1.0)

    def _take(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, share: float, *only: str
    ) -> None:
        """Log what is due at a share of the training: all but gradients, or these alone."""
        for kind in only or ("pictures", "meshes", "weights"):
            log, count = self.kinds[kind]
            due = count if share == 1 else int(share * (count - 1)) + 1 if count > 1 else 0
            if due <= self.taken[kind] and not (count and share == 1):
                continue  # a run that is resumed after its end has another one
            if not trainer.is_global_zero or not takes_pictures(trainer.loggers):
                return
            self.taken[kind] = due
            for index, module in enumerate(members(pl_module).values()):
                log(loggers_of(trainer.loggers, index), module, trainer.global_step)

    def _picture(self, loggers: Sequence[Logger], module: Any, step: int) -> None:
        picture = self.draw(module)
        if picture is not None:
            log_picture(loggers, self.name, picture, step)

    def _mesh(self, loggers: Sequence[Logger], module: Any, step: int) -> None:
        writers = event_files(loggers)
        mesh = self.mesh(module) if writers else None
        if mesh is None or len(mesh.vertices) > _MOST_VERTICES:
            return
        vertices, faces, colours = (torch.as_tensor(part)[None] for part in mesh)
        for writer in writers:
            writer.add_mesh(self.name, vertices, colours, faces, global_step=step)

    def _weights(self, loggers: Sequence[Logger], module: Any, step: int) -> None:
        for name, weights in module.named_parameters():
            if weights.requires_grad:
                _histogram(loggers, f"weights/{name}", weights.detach(), step)

    def _gradients(self, loggers: Sequence[Logger], module: Any, step: int) -> None:
        for name, weights in module.named_parameters():
            if weights.grad is not None:
                _histogram(loggers, f"gradients/{name}", weights.grad, step)

    def state_dict(self) -> dict[str, Any]:
        return {"taken": dict(self.taken)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        taken = state_dict["taken"]
        # earlier versions counted pictures alone
        self.taken.update(taken if isinstance(taken, dict) else {"pictures": taken})


def _histogram(loggers: Sequence[Logger], name: str, values: torch.Tensor, step: int) -> None:
    for writer in event_files(loggers) if values.isfinite().all() else ():
        writer.add_histogram(name, values, step)
