"""Overfit: a network φ: Ω → R³ is trained to be the surface (METHOD, Eq. 1)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nsm.data import Samples
from nsm.energies import first_fundamental_form
from nsm.energies.overfit import normal, position
from nsm.maps.networks import build_network
from nsm.settings import OverfitWeights
from nsm.tasks.terms import Evaluation, Term, made_terms
from nsm.tasks.training import Training


class Overfit(Training):
    """L = mean ‖f − φ‖² + λ_n mean ‖n_φ − n_f‖² over samples of the surface.

    Args:
        map, activation, encoding: settings of the network φ (see
            :func:`nsm.maps.networks.build_network`).
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps: length of the schedule.
        loss_weights: of :class:`nsm.settings.OverfitWeights`.
        diagonal: of the surface's bounding box, the unit of the logged errors.
        loss_terms: the user's own (see :mod:`nsm.tasks.terms`).
    """

    Weights = OverfitWeights
    progress_figure, progress_form = "val/rms_percent", "error {:.3f} %"

    def __init__(
        self,
        map: dict[str, Any],
        activation: dict[str, Any],
        encoding: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        max_steps: int,
        loss_weights: dict[str, float],
        diagonal: float,
        loss_terms: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.map = build_network(map=map, activation=activation, encoding=encoding, out_dim=3)
        self.loss_weights = OverfitWeights(**loss_weights)
        self.loss_terms = made_terms(loss_terms or {})
        self.diagonal = diagonal

    def forward(self, uv: Tensor) -> Tensor:
        """φ: (N, 2) points of Ω to (N, 3)."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        w = self.loss_weights
        phi, jacobian = self._evaluated(batch.uv)
        P = position(phi, batch.points).mean()
        N = 0.0 if jacobian is None else normal(jacobian, batch.normals).mean()

        loss = P + w.normal * N
        terms: dict[str, Term] = {"position": (1.0, P), "normal": (w.normal, N)}
        for name, term in self.loss_terms.items():
            B = None if jacobian is None else first_fundamental_form(jacobian)
            terms[name] = (term.weight, term(Evaluation(batch.uv, batch.points, phi, target=B)))
            loss = loss + term.weight * terms[name][1]
        self.log_terms(loss, terms)
        return loss

    def _evaluated(self, uv: Tensor) -> tuple[Tensor, Tensor | None]:
        """φ (N, 3) and, where a term needs it, J_φ (N, 3, 2) at points (N, 2) of Ω."""
        if self.loss_weights.normal == 0 and not self.loss_terms:
            return self.pointwise(self._value, uv)[0], None
        phi, jacobian = self.pointwise(self.map.value_and_jacobian, uv)
        return phi, jacobian

    def _value(self, uv: Tensor) -> tuple[Tensor]:
        return (self.map(uv),)

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        phi, jacobian = self.map.value_and_jacobian(batch.uv)
        self.log_figures(held_out_errors(phi, jacobian, batch), batch_size=len(phi))

    def on_validation_epoch_end(self) -> None:
        # the root is taken after the mean over all batches
        squared = self.trainer.callback_metrics[SQUARED]
        self.log("val/rms_percent", 100 * squared.sqrt() / self.diagonal)


SQUARED = "val/mean_squared_distance"


def held_out_errors(value: Tensor, jacobian: Tensor, batch: Samples) -> dict[str, Tensor]:
    """Errors of values (..., N, 3) and Jacobians (..., N, 3, 2) at held-out points, as the log
    names them: means over N samples, (...)."""
    cross = torch.linalg.cross(jacobian[..., 0], jacobian[..., 1])
    cosine = torch.nn.functional.cosine_similarity(cross, batch.normals, dim=-1)
    return {
        SQUARED: position(value, batch.points).mean(dim=-1),
        "val/normal_error_degrees": torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).mean(dim=-1),
    }
