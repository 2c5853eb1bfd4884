"""The triangles of a mesh to be laid out on R²/Γ: what is the same for all lifts and cones.

Sets of cones are compared on one coarse mesh. Shapes of triangles, patterns of sparse matrices and
sets of vertices that may move at once are made only once for all of them.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from nsm.domains.orbifold.pattern import Pattern
from nsm.domains.orbifold.stars import Stars, hats
from nsm.domains.vertex_relaxation import colours
from nsm.surfaces import topology


class Triangles:
    """Triangles of a mesh with the domain's area.

    Args:
        vertices: (V, 3), scaled so that the mesh has the domain's area.
        faces: (F, 3).

    Attributes:
        hats: (3, F), and area, (F,): see :func:`nsm.domains.orbifold.stars.hats`.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.vertices, self.faces = vertices, faces
        self.hats, self.area = hats(vertices, faces)

    @cached_property
    def pattern(self) -> Pattern:
        """Of second derivatives by the vertices' coordinates."""
        return Pattern(self.faces, len(self.vertices))

    @cached_property
    def classes(self) -> list[Stars]:
        """The stars of all vertices, no two neighbours in one class."""
        ids, local = topology.renumbered(self.faces, len(self.vertices))
        owner = local[self.faces.ravel()]
        colour = colours(owner.reshape(-1, 3), len(ids))
        order = np.argsort(colour, kind="stable")
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        every = Stars(self.vertices, self.faces, ids[order], np.arange(len(owner)), place[owner])
        return every.split(np.cumsum(np.bincount(colour)))
