"""What maps of one mesh share: where their distortion is measured, and the term G there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import At
from nsm.energies.metrics import determinant
from nsm.tasks.at_triangles import AtTriangles
from nsm.tasks.curvature import positive_hessians
from nsm.tasks.fold_barrier import FoldBarrier, Folds
from nsm.tasks.mesh_quadrature import MeshQuadrature, Triangles
from nsm.tasks.terms import Distortion, Evaluation

# of a large mesh's triangles, whatever the batch is: fewer would be overfitted
_FEWEST = 24_576


class Places(NamedTuple):
    """Points of a step and what they stand for.

    Attributes:
        uv: (N, 2) in Ω.
        at: where they lie.
        share: (N,) of the area.
        told: (N,) 1 where a fold counts, 0 where single precision does not tell.
        determinant: (N,) of triangles under h relative to their own; None: that of J_h.
    """

    uv: Tensor
    at: At
    share: Tensor
    told: Tensor
    determinant: Tensor | None


class OneMeshMap(AtTriangles):
    """Base of the tasks that map one mesh, whose triangles are where distortion may be measured.

    Attributes:
        energy: of the metrics A and B, a blend.
        folds: of det J_h.
        fold_barrier: of the mesh's triangles.
    """

    quadrature: MeshQuadrature | None
    fold_barrier: FoldBarrier

    energy: Any
    folds: Folds

    def set_quadrature(
        self, share: float, max_steps: int, uv: Tensor, faces: Tensor, surface: nn.Module
    ) -> None:
        """Measure at triangles after a share of the steps; with all of them, at samples alone.

        Args:
            share: of the steps.
            max_steps: their number.
            uv, faces, surface: see :class:`nsm.tasks.mesh_quadrature.MeshQuadrature`.
        """
        self.triangles_from = share * max_steps
        if share < 1:
            self.quadrature = MeshQuadrature(uv, faces, surface)

    def triangles(self, batch_size: int) -> Triangles | None:
        """Those at which the distortion of a training step is measured; None: it is at samples."""
        if self.quadrature is None or self.global_step < self.triangles_from:
            return None
        return self.quadrature.take(max(batch_size, _FEWEST))

    def _places(self, batch: Samples) -> Places:
        """Where a step measures: at samples, or at triangles, for which their centres stand."""
        if (some := self.triangles(len(batch.uv))) is None:
            one = batch.uv.new_ones(len(batch.uv))
            return Places(batch.uv, At(batch.uv, batch.points), one / len(one), one, None)
        with torch.no_grad():
            relative = some.relative(self.map(some.uv))
        told = some.oriented / some.share.clamp(min=1e-30)
        return Places(some.centres, some.at, some.share, told, relative)

    def _hessians(
        self,
        places: Places,
        source: Tensor,
        jacobian: Tensor,
        metric: Callable[[Tensor], Tensor],
        folding: float,
    ) -> Tensor:
        """Second derivatives (N, 4, 4) of distortion and folds by J_h at places, by their shares.

        Args:
            places: N of them.
            source: A (N, 2, 2).
            jacobian: J_h (N, 2, 2).
            metric: from J_h to B, each (N, 2, 2).
            folding: λ_inv.
        """
        folds = self._folds_near(places, jacobian, folding)

        def loss(j: Tensor) -> Tensor:
            values = self.energy.total(self.energy.parts(source, metric(j), places.at))
            return values + folds(j)

        return places.share.double()[:, None, None] * positive_hessians(loss, jacobian)

    def _folds_near(
        self, places: Places, jacobian: Tensor, folding: float
    ) -> Callable[[Tensor], Tensor]:
        """The fold term (N,) at places, as a function of J_h (N, 2, 2); arguments as above."""
        excess: Tensor | float = 0.0  # of a triangle's determinant, where it is not that of J_h
        if places.determinant is not None:
            excess = places.determinant - determinant(jacobian)

        def folds(j: Tensor) -> Tensor:
            det = determinant(j) + excess
            return folding * places.told * self.folds(det, self.global_step, smooth=True)

        return folds

    def _on_triangles(
        self, some: Triangles, h: Tensor, image_metric: Tensor
    ) -> tuple[Distortion, Evaluation]:
        """The energy of the map that is linear on triangles, and what it is made from.

        Args:
            some: the triangles.
            h: (V, 2) of their corners.
            image_metric: B (F, 2, 2), in the frames of their first two sides.
        """
        parts = self.energy.parts(some.metric, image_metric, some.at)
        det = some.relative(h)
        evaluation = Evaluation(
            some.centres,
            some.positions,
            some.centres_on(h),
            some.metric,
            image_metric,
            det,
            some.oriented,
        )
        return Distortion(self.energy, parts, some.share), evaluation

    def _weakest(self) -> Tensor | float:
        """U: the triangles nearest to folding; 0.0 where G looks at all of them."""
        if self.quadrature is not None and self.global_step >= self.triangles_from:
            return 0.0
        return self.fold_barrier(self.map, self.global_step)

    def _folding(self, e: Evaluation) -> Tensor:
        """G: the mean over samples, or triangles by their area."""
        if e.share is None:
            return self.folds(e.determinant, self.global_step).mean()
        return (e.share * self.folds(e.determinant, self.global_step, smooth=True)).sum()
