"""Several surfaces overfitted in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from nsm.data import Samples
from nsm.energies.overfit import normal, position
from nsm.maps import batched
from nsm.tasks.ensemble import Ensemble
from nsm.tasks.overfit import SQUARED, Overfit, held_out_errors


class OverfitEnsemble(Ensemble):
    """k surfaces at once, each as :class:`nsm.tasks.Overfit` has it, the networks in one batch.

    Args:
        each: their modules, with networks of one configuration; seeds, λ_n and the optimizer's
            rates may differ.
    """

    progress_figure, progress_form = "val/rms_percent", "largest error {:.3f} %"
    lambda_normal: Tensor
    units: Tensor

    def __init__(self, each: Sequence[Overfit]) -> None:
        super().__init__(each)
        self._batched = (batched([one.map for one in each]),)  # no module of its own
        lambdas = [one.loss_weights.normal for one in each]
        self.some_normals = any(lambdas)
        self.register_buffer("lambda_normal", torch.tensor(lambdas), persistent=False)
        units = torch.tensor([one.diagonal for one in each])
        self.register_buffer("units", units, persistent=False)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        phi, jacobian = self._evaluated(batch.uv)
        P = position(phi, batch.points).mean(dim=-1)
        N = normal(jacobian, batch.normals).mean(dim=-1) if self.some_normals else 0.0

        loss = P + self.lambda_normal * N
        self.log_terms(loss, {"position": (1.0, P), "normal": (self.lambda_normal, N)})
        return loss.sum()

    def _evaluated(self, uv: Tensor) -> tuple[Tensor, ...]:
        """Values (k, N, 3) and Jacobians (k, N, 3, 2)."""

        def by_point(x: Tensor) -> tuple[Tensor, ...]:
            both = self._batched[0].value_and_jacobian(x.transpose(0, 1))
            return tuple(part.transpose(0, 1) for part in both)

        return tuple(part.transpose(0, 1) for part in self.pointwise(by_point, uv.transpose(0, 1)))

    def has_figure(self, index: int, name: str) -> bool:
        one = cast(Overfit, self.each[index])
        return not name.endswith("/normal") or one.loss_weights.normal != 0

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        value, jacobian = self._batched[0].value_and_jacobian(batch.uv)
        self.log_figures(held_out_errors(value, jacobian, batch), batch_size=value.shape[1])

    def on_validation_epoch_end(self) -> None:
        known = self.trainer.callback_metrics
        squared = torch.stack([known[f"{SQUARED}@{i}"] for i in range(len(self.each))])
        error = 100 * squared.sqrt().to(self.units) / self.units
        self.log_figures({"val/rms_percent": error})
        self.log("val/rms_percent", error.max(), logger=False)
