"""The triangles of a mesh to be laid out on R²/Γ: what is the same for all lifts and cones.

Sets of cones are compared on one coarse mesh. Shapes of triangles and patterns of sparse matrices
are made only once for all of them.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from nsm.domains.orbifold.stars import Stars, hats
from nsm.domains.sparse_systems import Pattern
from nsm.domains.vertex_relaxation import colours
from nsm.surfaces import topology


class Triangles:
    """Triangles of a mesh with the domain's area.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        scale: of areas, which makes that of the mesh the domain's.

    Attributes:
        hats: (F, 3), and area, (F,): see :func:`nsm.domains.orbifold.stars.hats`.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, scale: float) -> None:
        self.vertices, self.faces, self.scale = vertices, faces, scale
        self.hats, self.area = hats(vertices, faces)
        self.hats /= np.sqrt(scale)
        self.area *= scale

    @cached_property
    def pattern(self) -> Pattern:
        """Of second derivatives by the vertices' coordinates."""
        return Pattern(self.faces, len(self.vertices))

    @cached_property
    def stars(self) -> Stars:
        """Those of all vertices: a set without neighbours, then another one, and so on."""
        ids, local = topology.renumbered(self.faces, len(self.vertices))
        owner = local[self.faces.ravel()]
        colour = colours(owner.reshape(-1, 3), len(ids))
        order = np.argsort(colour, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        return Stars.of(
            self.vertices, self.faces, self.scale, ids[order], np.arange(len(owner)), place[owner]
        )
