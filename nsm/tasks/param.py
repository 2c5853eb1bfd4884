"""Param: a map h: Ω → R² of a frozen neural surface φ to the plane, with least distortion."""

from __future__ import annotations

from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import blend, boundary, first_fundamental_form, injectivity
from nsm.maps.planar import PlanarMap
from nsm.tasks.optimizers import configure

BOUNDARIES = ("free", "fixed")
_BOUNDARY_POINTS = 512


class Param(pl.LightningModule):
    """L = mean E(A, B) + λ_inv mean G(det J_h), A = J_φᵀJ_φ, B = J_hᵀJ_h (METHOD, Param).

    With a fixed boundary, λ_B mean σ(h(∂Ω)) is added, and the image of ∂Ω slides on ∂Ω.

    Args:
        map: configuration of h's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps: length of the schedule.
        domain: ``disc`` or ``square``.
        weights: energies by name with their weights (see :mod:`nsm.energies`).
        lambda_injectivity, lambda_boundary: λ_inv and λ_B.
        boundary: ``free`` or ``fixed``.
        phi: the surface; it is not trained.

    Raises:
        ValueError: an energy or a boundary that is not known.
    """

    progress_figure, progress_form = "val/distortion", "distortion {:.3f}"

    def __init__(
        self,
        map: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        max_steps: int,
        domain: str,
        weights: dict[str, float],
        lambda_injectivity: float,
        lambda_boundary: float,
        boundary: str,
        phi: nn.Module,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["phi"])
        if boundary not in BOUNDARIES:
            raise ValueError(f"boundary {boundary!r} is not one of {', '.join(BOUNDARIES)}")
        self.energy = blend(weights)
        self.map = PlanarMap(**map)
        self.phi = phi.eval().requires_grad_(False)
        self.domain, self.fixed = domain, boundary == "fixed"
        self.lambda_injectivity, self.lambda_boundary = lambda_injectivity, lambda_boundary
        self.register_buffer("rim", _rim(domain), persistent=False)

    rim: Tensor

    def forward(self, uv: Tensor) -> Tensor:
        """(N, 2) points of Ω to the plane."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        distortion, determinant = self._distortion(batch.uv)
        fold = injectivity(determinant).mean()
        loss = distortion + self.lambda_injectivity * fold
        self.log("train/distortion", distortion)
        self.log("train/injectivity", fold)
        if self.fixed:
            off = boundary(self.domain, self.map(self.rim)).mean()
            loss = loss + self.lambda_boundary * off
            self.log("train/boundary", off)
        self.log("train/loss", loss)
        return loss

    def _distortion(self, uv: Tensor) -> tuple[Tensor, Tensor]:
        """Mean energy at points (N, 2) of Ω, and det J_h (N,) there; φ's work is not recorded."""
        with torch.no_grad():
            source = first_fundamental_form(self.phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        _, jacobian = self.map.value_and_jacobian(uv)
        energy = self.energy(source, first_fundamental_form(jacobian)).mean()
        return energy, torch.linalg.det(jacobian)

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        distortion, determinant = self._distortion(batch.uv)
        folded = 100 * (determinant <= 0).double().mean()
        self.log("val/distortion", distortion, batch_size=len(batch.uv))
        self.log("val/folded_percent", folded, batch_size=len(batch.uv))

    def configure_optimizers(self) -> Any:
        return configure(self.map, self.hparams)


def _rim(domain: str) -> Tensor:
    """Points (N, 2) all along ∂Ω."""
    t = torch.arange(_BOUNDARY_POINTS) / _BOUNDARY_POINTS
    if domain == "disc":
        return torch.stack([torch.cos(2 * torch.pi * t), torch.sin(2 * torch.pi * t)], dim=1)
    side, along = (4 * t).long(), 2 * (4 * t).frac() - 1
    one = torch.ones_like(t)
    points = [(along, -one), (one, along), (-along, one), (-one, -along)]
    return torch.stack([torch.stack(p, dim=1) for p in points])[side, torch.arange(len(t))]
