"""Fill small holes of a mesh, so that surfaces with and without them have one topology.

Each hole is closed by a fan around one inserted vertex, as libigl's ``topological_hole_fill`` does,
which its Python package lacks: whatever the hole's shape, the result is a manifold. A triangulation
of the hole's own vertices may use an edge that the mesh has already.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsm.surfaces import topology
from nsm.wording import number_of

# The numbers of inserted vertices: -2, -3, ...; -1 is taken by points that cuts insert.
FIRST = -2
# A loop is a small hole if it is shorter than this times the square root of the area. A round one
# has then 2 % of it; the neck of a bust, or the edge of a face scan, is longer.
SMALL = 0.5


def fill(
    vertices: np.ndarray, faces: np.ndarray, limit: bool | int
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Fill the small holes of a mesh.

    Args:
        vertices: (V, 3).
        faces: (F, 3), oriented and manifold.
        limit: the largest number of edges of a hole to fill; true: holes shorter than half the
            square root of the area.

    Returns:
        Vertices (V + H, 3), the H inserted ones last; faces, those over holes last; a log line,
        or none where there are no holes to fill.
    """
    loops = topology.boundary_loops(faces)
    short = SMALL * float(np.sqrt(topology.face_areas(vertices, faces).sum()))
    holes: list[np.ndarray] = []
    left: list[np.ndarray] = []
    for loop in loops:
        length = np.linalg.norm(vertices[loop] - vertices[np.roll(loop, -1)], axis=1).sum()
        small = length < short if limit is True else len(loop) <= limit
        (holes if small else left).append(loop)
    if not holes:
        return vertices, faces, []
    sizes = ", ".join(str(len(loop)) for loop in holes[:8]) + (", ..." if len(holes) > 8 else "")
    kept = ", ".join(str(len(loop)) for loop in left[:8])
    what = f"{number_of(len(holes), 'hole')} of {sizes} edges"
    line = f"{what} filled for the map, left out of exported meshes"
    line += f"; open boundaries of {kept} edges stay" if left else ""
    return *fans(vertices, faces, holes), [line]


def fans(
    vertices: np.ndarray, faces: np.ndarray, loops: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh (V, 3), (F, 3) with a fan over each of H boundary loops, around a new vertex at its
    mean: vertices (V + H, 3) and faces, the new ones last."""
    middles = np.stack([vertices[loop].mean(axis=0) for loop in loops])
    over = [
        np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(vertices) + k)], axis=1)
        for k, loop in enumerate(loops)
    ]
    return np.concatenate([vertices, middles]), np.concatenate([faces, *over])
