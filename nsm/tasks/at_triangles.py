"""What tasks share that measure distortion at samples, and in the end at triangles."""

from __future__ import annotations

import math
from typing import Any

from torch import nn

from nsm.tasks.training import Training


class AtTriangles(Training):
    """Base of the tasks whose distortion is measured at samples or, after a share of the steps, at
    the triangles of meshes.

    Attributes:
        quadrature: the triangles; None: samples throughout.
        triangles_from: the step from which they count.
    """

    quadrature: nn.Module | None
    triangles_from: float

    def __init__(self) -> None:
        super().__init__()
        self.quadrature, self.triangles_from = None, math.inf

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        if self.quasi_newton is not None and self.loss_changes:
            self.quasi_newton.begin_anew()

    @property
    def loss_changes(self) -> bool:
        """Whether the next step has a loss of another curvature than the one before."""
        return self.begins_at_triangles

    @property
    def begins_at_triangles(self) -> bool:
        """Whether the next step is the first at triangles."""
        return self.global_step - 1 < self.triangles_from <= self.global_step

    @property
    def is_over(self) -> bool:
        """Whether the training has made its last step."""
        return self.global_step >= self.trainer.max_steps

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_save_checkpoint(checkpoint)
        if self.is_over:  # no step goes on with what is known, which is large
            for state in checkpoint["optimizer_states"]:
                state.pop("known", None)
