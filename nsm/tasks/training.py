"""What all tasks share: figures of the training, taken where they are wanted."""

from __future__ import annotations

import pytorch_lightning as pl
from torch import Tensor


class Training(pl.LightningModule):
    """Base of the tasks.

    Attributes:
        log_every: steps between two values that the logger takes; in the steps between, Lightning
            would spend as long on figures as the network on its work.
    """

    log_every = 1

    def note(self, figures: dict[str, Tensor]) -> None:
        """Log figures of a training step as ``train/NAME``, in the steps that the logger takes."""
        if (self.global_step + 1) % self.log_every == 0:
            self.log_dict({f"train/{name}": value for name, value in figures.items()})
