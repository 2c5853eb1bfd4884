"""What tasks share that measure distortion at samples, and in the end at a mesh's triangles."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor, nn

from nsm.tasks.mesh_quadrature import MeshQuadrature, Triangles
from nsm.tasks.training import Training

# of a large mesh's triangles, whatever the batch is: fewer would be overfitted
_FEWEST = 24_576


class AtTriangles(Training):
    """Base of the tasks whose distortion is measured at samples or, after a share of the steps, at
    the triangles of a mesh.

    Attributes:
        quadrature: the triangles; None: samples throughout.
        triangles_from: the step from which they count.
    """

    quadrature: Any
    triangles_from: float

    def __init__(self) -> None:
        super().__init__()
        self.quadrature, self.triangles_from = None, math.inf

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
