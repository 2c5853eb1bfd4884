"""What maps of one mesh share: where their distortion is measured, and the term G there."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import At
from nsm.tasks.fold_barrier import Folds
from nsm.tasks.mesh_quadrature import MeshQuadrature, Triangles
from nsm.tasks.terms import Distortion, Evaluation
from nsm.tasks.training import Training


class OneMeshMap(Training):
    """Base of the tasks that map one mesh: distortion is measured at samples or, after a share of
    the steps, at the mesh's triangles.

    Attributes:
        energy: of the metrics A and B, a blend.
        folds: of det J_h.
        quadrature: the triangles; None: samples throughout.
        triangles_from: the step from which they count.
    """

    energy: Any
    folds: Folds
    quadrature: MeshQuadrature | None
    triangles_from: float

    def _set_quadrature(
        self, share: float, max_steps: int, uv: Tensor, faces: Tensor, surface: nn.Module
    ) -> None:
        """Measure at triangles after a share of the steps; with all of them, at samples alone."""
        self.quadrature, self.triangles_from = None, share * max_steps
        if share < 1:
            self.quadrature = MeshQuadrature(uv, faces, surface)

    def _triangles(self, batch: Samples) -> Triangles | None:
        """Those at which the distortion of a training step is measured; None: it is at samples."""
        if self.quadrature is None or self.global_step < self.triangles_from:
            return None
        return self.quadrature.take(len(batch.uv))

    def _places(self, batch: Samples) -> tuple[Tensor, At, Tensor]:
        """Points (N, 2) of a step, where they lie, and the share (N,) that each stands for:
        samples, or the centres of triangles."""
        if (some := self._triangles(batch)) is not None:
            return some.centres, some.at, some.share
        share = batch.uv.new_full((len(batch.uv),), 1 / len(batch.uv))
        return batch.uv, At(batch.uv, batch.points), share

    def _on_triangles(
        self, some: Triangles, h: Tensor, sides: Tensor, image_metric: Tensor
    ) -> tuple[Distortion, Evaluation]:
        """The energy of the map that is linear on triangles, and what it is made from.

        Args:
            some: the triangles.
            h: (V, 2) of their corners.
            sides: (F, 2, 2) of the triangles that h makes of them.
            image_metric: B (F, 2, 2), in the frames of their first two sides.
        """
        centre = some.centres_on(some.points)
        parts = self.energy.parts(some.metric, image_metric, some.at)
        det = sides.det() / some.determinant
        evaluation = Evaluation(
            some.centres, centre, some.centres_on(h), some.metric, image_metric, det, some.oriented
        )
        return Distortion(self.energy, parts, some.share), evaluation

    def _folding(self, e: Evaluation) -> Tensor:
        """G: the mean over samples, or triangles by their area."""
        assert e.source is not None and e.target is not None
        values = self.folds(e.determinant, e.source, e.target, self.global_step)
        return values.mean() if e.share is None else (e.share * values).sum()
