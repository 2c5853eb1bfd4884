"""Several trainings in one batch, each of which goes on as it would alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import pytorch_lightning as pl
from torch import Tensor, nn

from nsm.tasks.joint_optimizer import Shares, in_one
from nsm.tasks.schedules import scheduled
from nsm.tasks.training import Training


class EnsembleSplit(Exception):
    """Trainings in one batch cannot go on together.

    Args:
        reason: in short.
        which: those that have to be trained alone; the others may go on together.
    """

    def __init__(self, reason: str, which: Sequence[int]) -> None:
        super().__init__(reason)
        self.which = list(which)


class Ensemble(Training):
    """Base of k trainings in one batch.

    The loss is the sum of theirs, no network depends on another's share of it, and the optimizer's
    step of a parameter depends on that parameter alone, so that each becomes what it would alone.
    What is logged as ``NAME@i`` is the figure ``NAME`` of training i. A checkpoint is that of
    training ``shown``, as it would be alone, and the training goes on from one of each.

    Args:
        each: their modules, with the same settings but for the optimizer's rates and what the task
            allows to differ.

    Attributes:
        shown: whose checkpoint is written.
        stored: the checkpoints of all, of one step, that the training goes on from.
    """

    def __init__(self, each: Sequence[pl.LightningModule]) -> None:
        super().__init__()
        self.each = nn.ModuleList(each)
        self.shown = 0
        self.stored: list[dict[str, Any]] = []
        self.configure_optimizers()

    def configure_optimizers(self) -> Any:
        each = cast(Sequence[pl.LightningModule], self.each)
        own = [cast(Any, one.configure_optimizers())["optimizer"] for one in each]
        joint = in_one(own)
        self.shares = Shares(joint, own)
        return scheduled(joint, each[0].hparams)

    def log_figures(self, figures: Mapping[str, Tensor], batch_size: int | None = None) -> None:
        """Log figures (k,), one for each training."""
        self.log_dict(
            {
                f"{name}@{i}": value
                for name, values in figures.items()
                for i, value in enumerate(values)
                if self.has_figure(i, name)
            },
            batch_size=batch_size,
        )

    def has_figure(self, index: int, name: str) -> bool:
        """Whether a training has a figure of that name."""
        return True

    def weights_of(self, state: Mapping[str, Tensor], index: int) -> dict[str, Tensor]:
        """What training ``index`` has of this module's state."""
        start = f"each.{index}."
        return {key.removeprefix(start): v for key, v in state.items() if key.startswith(start)}

    def weights(self, states: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
        """This module's state, of what each training has."""
        each = enumerate(states)
        return {f"each.{i}.{key}": value for i, state in each for key, value in state.items()}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        one = cast(pl.LightningModule, self.each[self.shown])
        (optimizer,), (schedule,) = checkpoint["optimizer_states"], checkpoint["lr_schedulers"]
        checkpoint |= {
            "state_dict": self.weights_of(checkpoint["state_dict"], self.shown),
            "optimizer_states": [self.shares.of_optimizer(optimizer, self.shown)],
            "lr_schedulers": [self.shares.of_schedule(schedule, self.shown)],
            one.CHECKPOINT_HYPER_PARAMS_NAME: "kwargs",  # as Lightning calls them
            one.CHECKPOINT_HYPER_PARAMS_KEY: dict(one.hparams),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        checkpoint |= {
            "state_dict": self.weights([state["state_dict"] for state in self.stored]),
            "optimizer_states": [
                self.shares.optimizer([state["optimizer_states"][0] for state in self.stored])
            ],
            "lr_schedulers": [
                self.shares.schedule([state["lr_schedulers"][0] for state in self.stored])
            ],
        }

    def on_train_start(self) -> None:
        self.stored = []  # all is taken up


def members(module: pl.LightningModule) -> dict[str, nn.Module]:
    """The trainings of a module, by what ends the names of their figures in a log."""
    if isinstance(module, Ensemble):
        return {f"@{i}": one for i, one in enumerate(module.each)}
    return {"": module}
