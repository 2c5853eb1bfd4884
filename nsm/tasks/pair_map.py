"""PairMap: f: S → T with f∘φ = ψ∘h, through a map h of the domain."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import boundary, first_fundamental_form, injectivity, inside, outside
from nsm.maps import Composition, Rotated, build_planar
from nsm.tasks.constrained import ConstrainedMap
from nsm.tasks.fold_barrier import FoldBarrier
from nsm.tasks.terms import Distortion


class PairMap(ConstrainedMap):
    """L = mean E(A, B) + λ_inv G + λ_C C + λ_seam ‖ψ(h(a)) − ψ(h(b))‖² + λ_tri U (METHOD, B, G, C).

    A = J_φᵀJ_φ and B = J(ψ∘h)ᵀJ(ψ∘h) at samples of the source; U keeps its mesh's triangles from
    folding.

    Args:
        map: configuration of h's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps, domain, weights, constraints: see :class:`nsm.tasks.constrained.ConstrainedMap`.
        points, targets: landmarks P (L, 2) and Q (L, 2) in the domains of source and target.
        seam: (T, 2, 2) pairs of points of ∂Ω that are one point of the source, and whose images
            should be one point of the target.
        turn: rotation (2, 2) of h's input (see :mod:`nsm.tasks.initial_rotation`).
        mesh: uv (V, 2) and faces (F, 3) of the source, whose triangles must not flip.
        diagonal: of the target's bounding box, the unit of the errors that are logged.
        phi, psi: source and target; neither is trained.

    Raises:
        ValueError: a setting that is not known.
    """

    def __init__(
        self,
        map: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        max_steps: int,
        domain: str,
        weights: dict[str, float],
        constraints: dict[str, Any],
        points: Tensor,
        targets: Tensor,
        seam: Tensor,
        turn: Tensor,
        mesh: tuple[Tensor, Tensor],
        diagonal: float,
        phi: nn.Module,
        psi: nn.Module,
    ) -> None:
        super().__init__(domain, weights, constraints, max_steps)
        given = ["phi", "psi", "points", "targets", "seam", "turn", "mesh"]
        self.save_hyperparameters(ignore=given, logger=False)
        self.map = Rotated(build_planar({**map, "onto": self.constraints.onto(domain)}), turn)
        self.phi = phi.eval().requires_grad_(False)
        self.psi = psi.eval().requires_grad_(False)
        self.image = Composition(self.psi, self.map)
        self.fold_barrier = FoldBarrier(*mesh)
        self.diagonal = diagonal
        self.hold(points, targets, points @ turn.T, seam)

    def forward(self, uv: Tensor) -> Tensor:
        """h: (N, 2) points of Ω to (N, 2) in the target's domain."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        distortion, determinant, image = self._distortion(batch.uv)
        held = self.constraints
        terms = {"injectivity": injectivity(determinant).mean()}
        if held.boundary == "penalty":
            stray = outside(self.domain, image).mean()
            terms["boundary"] = (
                boundary(self.domain, self.map(self.boundary_samples)).mean() + stray
            )
        if len(self.seam) and held.lambda_seam > 0:
            terms["seam"] = self._seam_gap()
        if held.lambda_triangles > 0:
            terms["triangles"] = self.fold_barrier(self.map, self.global_step)
        return self.total(distortion, terms)

    def _distortion(self, uv: Tensor) -> tuple[Distortion, Tensor, Tensor]:
        """Energy at points (N, 2) of Ω, det J_h (N,) and h (N, 2) there."""
        source, target, jacobian, image = self.pointwise(self._at, uv)
        parts = self.energy.parts(source, target)
        if self.constraints.boundary == "penalty":  # samples that went astray do not count
            kept = inside(self.domain, image)
            parts = {name: part[kept] for name, part in parts.items()}
        return Distortion(self.energy, parts), torch.linalg.det(jacobian), image

    def _at(self, uv: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A, B, J_h and h at points (N, 2) of Ω."""
        with torch.no_grad():
            source = first_fundamental_form(self.phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        image, jacobian = self.map.value_and_jacobian(uv)
        _, outer = self.psi.value_and_jacobian(image)  # type: ignore[operator]
        return source, first_fundamental_form(outer @ jacobian), jacobian, image

    def _seam_gap(self) -> Tensor:
        """Mean squared distance on the target between the images of a seam point's two copies."""
        a, b = self.image(self.seam.reshape(-1, 2)).reshape(-1, 2, 3).unbind(dim=1)
        return ((a - b) ** 2).sum(dim=1).mean()

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        self.log_validation(*self._distortion(batch.uv))

    def flipped_percent(self) -> Tensor:
        return self.fold_barrier.flipped_percent(self.map)

    def landmark_error(self) -> Tensor:
        off = self.image(self.points) - self.psi(self.targets)
        return 100 / self.diagonal * off.norm(dim=1)
