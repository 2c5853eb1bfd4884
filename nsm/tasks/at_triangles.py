"""What tasks share that measure distortion at samples, and in the end at triangles."""

from __future__ import annotations

import math

from torch import nn

from nsm.tasks.training import Training


class AtTriangles(Training):
    """Base of the tasks whose distortion is measured at samples or, after a share of the steps, at
    the triangles of meshes.

    Attributes:
        quadrature: the triangles; None: samples throughout.
        triangles_from: the step from which they count.
    """

    quadrature: nn.Module | None
    triangles_from: float

    def __init__(self) -> None:
        super().__init__()
        self.quadrature, self.triangles_from = None, math.inf
