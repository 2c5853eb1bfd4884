"""CollectionMap: k surfaces, one map h_i of a common domain each, all pairs at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nsm.energies import boundary, first_fundamental_form, injectivity, inside, outside
from nsm.maps import Rotated, batched, build_planar
from nsm.tasks.constrained import ConstrainedMap
from nsm.tasks.fold_barrier import FoldBarrier
from nsm.tasks.terms import Distortion


class CollectionMap(ConstrainedMap):
    """Σ over ordered pairs of E(A_i, A_j), A_i = J(φ_i∘h_i)ᵀJ(φ_i∘h_i) (METHOD, Collection).

    F_{i→j}∘φ_i∘h_i = φ_j∘h_j, so each φ_i∘h_i is evaluated once a step, and the k² pairs only
    meet as 2×2 matrices. Each pair's distortion counts by the area of its source i.

    Args:
        map: configuration of each h_i's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps, domain, weights, constraints: see :class:`nsm.tasks.constrained.ConstrainedMap`.
        points: (K, 2) landmarks in the common domain.
        targets: (k, K, 2) the same in each surface's own.
        seam: (T, 2, 2) pairs of points of the common ∂Ω that are one point of each surface.
        turns: (k, 2, 2) rotations of the inputs.
        mesh: uv (V, 2), in the common domain, and faces (F, 3) of all surfaces together.
        diagonals: of each surface's bounding box, the units of the errors that are logged.
        phis: the surfaces; none is trained.

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
        turns: Tensor,
        mesh: tuple[Tensor, Tensor],
        diagonals: Sequence[float],
        phis: Sequence[nn.Module],
    ) -> None:
        super().__init__(domain, weights, constraints, max_steps)
        given = ["phis", "points", "targets", "seam", "turns", "mesh"]
        self.save_hyperparameters(ignore=given, logger=False)
        planar = {**map, "onto": self.constraints.onto(domain)}
        self.map = nn.ModuleList(Rotated(build_planar(planar), turn) for turn in turns)
        self.phis = nn.ModuleList(phi.eval().requires_grad_(False) for phi in phis)
        self.fold_barrier = nn.ModuleList(FoldBarrier(*mesh) for _ in phis)
        self.hold(points, targets, points @ turns.transpose(1, 2), seam)
        self.diagonals = diagonals
        i, j = torch.meshgrid(torch.arange(len(phis)), torch.arange(len(phis)), indexing="ij")
        self.ordered = (i[i != j], j[i != j])

    def forward(self, x: Tensor) -> Tensor:
        """Points (N, 2) of the common domain to those of all surfaces, (k, N, 2)."""
        every: Tensor = batched(list(self.map))(x.expand(len(self.map), -1, -1))
        return every

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        distortion, determinant, images = self._distortion(batch)
        held = self.constraints
        terms = {"injectivity": injectivity(determinant).mean(dim=1).sum()}
        if held.boundary == "penalty":
            stray = outside(self.domain, images).mean(dim=1).sum()
            terms["boundary"] = (
                boundary(self.domain, self(self.boundary_samples)).mean(dim=1).sum() + stray
            )
        if len(self.seam) and held.lambda_seam > 0:
            terms["seam"] = self._seam_gap()
        if held.lambda_triangles > 0:
            both = zip(self.map, self.fold_barrier, strict=True)
            terms["triangles"] = torch.stack([w(h, self.global_step) for h, w in both]).sum()
        return self.total(distortion, terms)

    def _distortion(self, x: Tensor) -> tuple[Distortion, Tensor, Tensor]:
        """Energy of the ordered pairs at points (N, 2), all det J_h (k, N), and all h (k, N, 2)
        there."""
        forms, determinants, everywhere = (
            part.transpose(0, 1) for part in self.pointwise(self._at, x)
        )
        # samples lie by the mean of the surfaces' areas: weights make it that of each source
        area = torch.linalg.det(forms.detach()).clamp(min=0).sqrt()
        share = area / area.mean(dim=0).clamp(min=1e-12)
        if self.constraints.boundary == "penalty":  # samples that went astray do not count
            share = share * inside(self.domain, everywhere.detach()).all(dim=0)
        i, j = self.ordered
        parts = self.energy.parts(forms[i], forms[j])
        return Distortion(self.energy, parts, share[i]), determinants, everywhere

    def _at(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A_i (N, k, 2, 2), det J_h (N, k) and h (N, k, 2) of all surfaces at points (N, 2)."""
        images, inner = batched(list(self.map)).value_and_jacobian(x.expand(len(self.map), -1, -1))
        _, outer = batched(list(self.phis)).value_and_jacobian(images)
        metrics = first_fundamental_form(outer @ inner)
        return tuple(part.transpose(0, 1) for part in (metrics, torch.linalg.det(inner), images))  # type: ignore[return-value]

    def _seam_gap(self) -> Tensor:
        """Σ over surfaces of the mean squared distance between a seam point's two copies."""
        a, b = (
            batched(list(self.phis))(self(self.seam.reshape(-1, 2))).unflatten(1, (-1, 2)).unbind(2)
        )
        return ((a - b) ** 2).sum(dim=-1).mean(dim=1).sum()

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        self.log_validation(*self._distortion(batch))

    def flipped_percent(self) -> Tensor:
        both = zip(self.map, self.fold_barrier, strict=True)
        return torch.stack([w.flipped_percent(h) for h, w in both]).mean()  # type: ignore[operator]

    def landmark_error(self) -> Tensor:
        phis = batched(list(self.phis))
        units = self.targets.new_tensor(self.diagonals)[:, None]
        return 100 / units * (phis(self(self.points)) - phis(self.targets)).norm(dim=-1)
