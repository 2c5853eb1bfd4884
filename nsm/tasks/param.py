"""Param: a map h: Ω → R² of a frozen neural surface φ to the plane, with least distortion."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import At, first_fundamental_form
from nsm.energies.metrics import determinant
from nsm.settings import ParamConstraints, ParamWeights
from nsm.tasks.boundary_barrier import BoundaryBarrier
from nsm.tasks.curvature import Curvature
from nsm.tasks.fold_barrier import FoldBarrier, Folds, further_training, stronger
from nsm.tasks.one_mesh import OneMeshMap
from nsm.tasks.planar import planar_map
from nsm.tasks.terms import Distortion, Evaluation, HeldOut, Term, as_blend, made_terms


class Param(OneMeshMap):
    """L = mean E(A, B) + λ_inv mean G(det J_h) + λ_tri U, A = J_φᵀJ_φ, B = J_hᵀJ_h (METHOD, Param).

    U keeps the mesh's triangles from folding (:class:`nsm.tasks.fold_barrier.FoldBarrier`). With a
    fixed boundary h maps Ω to itself by construction, and the image of ∂Ω slides on ∂Ω: a map that
    folds nowhere is then bijective.

    Args:
        map, activation, encoding: settings of h's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps: length of the schedule.
        loss_weights: of :class:`nsm.settings.ParamWeights`.
        constraints: of :class:`nsm.settings.ParamConstraints`.
        domain: Ω (see :class:`nsm.domains.Domain`).
        energy: of the metrics A and B (see :mod:`nsm.energies`).
        mesh: uv (V, 2), faces (F, 3) and areas (F,) of the mesh whose triangles must not flip.
        phi: the surface; it is not trained.
        loss_terms: the user's own (see :mod:`nsm.tasks.terms`).
        start: h before its training, where the boundary is free; None: the identity.

    Raises:
        ValueError: a constraint that is not known.
    """

    Weights, Constraints = ParamWeights, ParamConstraints

    def __init__(
        self,
        map: dict[str, Any],
        activation: dict[str, Any],
        encoding: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        max_steps: int,
        loss_weights: dict[str, float],
        constraints: dict[str, Any],
        domain: Any,
        energy: Any,
        mesh: tuple[Tensor, Tensor, Tensor],
        phi: nn.Module,
        loss_terms: dict[str, Any] | None = None,
        start: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["domain", "energy", "phi", "mesh", "start"], logger=False)
        self.loss_weights = ParamWeights(**loss_weights)
        held = ParamConstraints(**constraints)
        fixed, self.folds = held.boundary == "fixed", Folds(held.injectivity)
        apart = held.boundary == "apart"
        self.boundary_barrier = BoundaryBarrier(*mesh[:2]) if apart else None
        self.map = planar_map(domain if fixed else None, map, activation, encoding, start)
        self.energy = as_blend(energy)
        self.loss_terms = made_terms(loss_terms or {})
        self.phi = phi.eval().requires_grad_(False)
        self.fold_barrier = FoldBarrier(*mesh, every=held.fold_every)
        self.set_quadrature(held.triangles_from, max_steps, *mesh[:2], self.phi)
        self.held_out = HeldOut()

    def forward(self, uv: Tensor) -> Tensor:
        """h: (N, 2) points of Ω to the plane."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        self.batch = batch
        w = self.loss_weights
        distortion, evaluation = self._evaluated(batch)
        energy = distortion.mean
        G = self._folding(evaluation)
        U = self._weakest() if w.triangles > 0 else 0.0
        P = (
            self.boundary_barrier(self.map, self.global_step)
            if self.boundary_barrier is not None
            else 0.0
        )

        loss = energy + w.injectivity * G + w.triangles * U + P
        terms: dict[str, Term] = {
            **distortion.terms,
            "injectivity": (w.injectivity, G),
            "triangles": (w.triangles, U),
            "boundary": (1.0, P),
        }
        for name, term in self.loss_terms.items():
            terms[name] = (term.weight, term(evaluation))
            loss = loss + term.weight * terms[name][1]
        self.log_terms(loss, terms, distortion=energy)
        return loss

    def _evaluated(self, batch: Samples) -> tuple[Distortion, Evaluation]:
        """The energy at samples, and what it is made from; φ's part is not recorded."""
        if self.training and (some := self.triangles(len(batch.uv))) is not None:
            h = self.map(some.uv)
            return self._on_triangles(some, h, some.forms(h))
        A, jacobian, h = self.pointwise(self._at, batch.uv)
        B = first_fundamental_form(jacobian)
        parts = self.energy.parts(A, B, At(batch.uv, batch.points))
        det = determinant(jacobian)
        return Distortion(self.energy, parts), Evaluation(batch.uv, batch.points, h, A, B, det)

    def _at(self, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A, J_h and h at points (N, 2) of Ω."""
        with torch.no_grad():
            source = first_fundamental_form(self.phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        h, jacobian = self.map.value_and_jacobian(uv)
        return source, jacobian, h

    def curvatures(self) -> list[Curvature]:
        places, folding = self._places(self.batch), self.loss_weights.injectivity
        with torch.no_grad():
            source, jacobian, _ = self._at(places.uv)

        hessians = self._hessians(places, source, jacobian, first_fundamental_form, folding)
        found = [Curvature(self.map, places.uv, hessians)]
        if self.boundary_barrier is not None:
            found.append(self.boundary_barrier.curvature(self.map, self.global_step))
        return found

    def on_train_start(self) -> None:
        self._stop_if_converged()  # a resumed training may have been

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_end(outputs, batch, batch_idx)
        self._stop_if_converged()

    def _stop_if_converged(self) -> None:
        # the loss is the same in each step, unlike that of maps with multipliers
        if self.quasi_newton is not None and self.quasi_newton.converged:
            self.trainer.should_stop = True

    def strengthen(self, steps: int) -> None:
        """As :meth:`nsm.tasks.constrained.ConstrainedMap.strengthen`."""
        self.loss_weights = stronger(self.loss_weights)
        further_training(self, steps)

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        distortion, evaluation = self._evaluated(batch)
        folded = 100 * (evaluation.determinant <= 0).double().mean()
        self.held_out.add(distortion)
        self.log("val/distortion", distortion.mean, batch_size=len(batch.uv))
        self.log("val/folded_percent", folded, batch_size=len(batch.uv))

    def on_validation_epoch_end(self) -> None:
        self.log("val/distortion_median", self.held_out.median())
        self.log("val/flipped_percent", self.fold_barrier.flipped_percent(self.map))
