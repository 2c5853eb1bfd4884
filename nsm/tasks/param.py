"""Param: a map h: Ω → R² of a frozen neural surface φ to the plane, with least distortion."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import Blend, first_fundamental_form, injectivity
from nsm.maps import build_planar
from nsm.tasks.fold_barrier import FoldBarrier, carefully, stronger
from nsm.tasks.optimizers import configure
from nsm.tasks.terms import Distortion, HeldOut, Term
from nsm.tasks.training import Training

BOUNDARIES = ("free", "fixed")


class Param(Training):
    """L = mean E(A, B) + λ_inv mean G(det J_h) + λ_tri U, A = J_φᵀJ_φ, B = J_hᵀJ_h (METHOD, Param).

    U keeps the mesh's triangles from folding (:class:`nsm.tasks.fold_barrier.FoldBarrier`). With a
    fixed boundary h keeps to Ω by construction, and the image of ∂Ω slides on ∂Ω: a map that folds
    nowhere is then bijective.

    Args:
        map: configuration of h's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps: length of the schedule.
        domain: ``disc`` or ``square``.
        weights: energies by name with their weights (see :mod:`nsm.energies`).
        lambda_injectivity, lambda_triangles: λ_inv and λ_tri.
        boundary: ``free`` or ``fixed``.
        mesh: uv (V, 2), faces (F, 3) and areas (F,) of the mesh whose triangles must not flip.
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
        lambda_triangles: float,
        boundary: str,
        mesh: tuple[Tensor, Tensor, Tensor],
        phi: nn.Module,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["phi", "mesh"], logger=False)
        if boundary not in BOUNDARIES:
            raise ValueError(f"boundary {boundary!r} is not one of {', '.join(BOUNDARIES)}")
        self.energy = Blend(weights)
        self.map = build_planar({**map, "onto": domain if boundary == "fixed" else None})
        self.phi = phi.eval().requires_grad_(False)
        self.lambda_injectivity, self.lambda_triangles = lambda_injectivity, lambda_triangles
        self.fold_barrier = FoldBarrier(*mesh)
        self.held_out = HeldOut()

    def forward(self, uv: Tensor) -> Tensor:
        """(N, 2) points of Ω to the plane."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        distortion, determinant = self._distortion(batch.uv)
        fold = injectivity(determinant).mean()
        terms: dict[str, Term] = {
            **distortion.terms,
            "injectivity": (self.lambda_injectivity, fold),
        }
        if self.lambda_triangles > 0:
            terms["triangles"] = (
                self.lambda_triangles,
                self.fold_barrier(self.map, self.global_step),
            )
        self.note({"distortion": distortion.mean})
        return self.summed(terms)

    def _distortion(self, uv: Tensor) -> tuple[Distortion, Tensor]:
        """Energy at points (N, 2) of Ω, and det J_h (N,) there; φ's work is not recorded."""
        source, jacobian = self.pointwise(self._at, uv)
        parts = self.energy.parts(source, first_fundamental_form(jacobian))
        return Distortion(self.energy, parts), torch.linalg.det(jacobian)

    def _at(self, uv: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            source = first_fundamental_form(self.phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        return source, self.map.value_and_jacobian(uv)[1]

    def strengthen(self, steps: int) -> None:
        """As :meth:`nsm.tasks.constrained.ConstrainedMap.strengthen`."""
        self.lambda_triangles = stronger(self.lambda_triangles)
        carefully(self, steps)

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        distortion, determinant = self._distortion(batch.uv)
        folded = 100 * (determinant <= 0).double().mean()
        self.held_out.add(distortion)
        self.log("val/distortion", distortion.mean, batch_size=len(batch.uv))
        self.log("val/folded_percent", folded, batch_size=len(batch.uv))

    def on_validation_epoch_end(self) -> None:
        self.log("val/distortion_median", self.held_out.median())
        self.log("val/flipped_percent", self.fold_barrier.flipped_percent(self.map))

    def configure_optimizers(self) -> Any:
        return configure(self.map, self.hparams)
