"""Limbs that a seam does not reach: parts that no plane shows without much distortion."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from nsm.surfaces import topology

_LEVEL = 0.05  # between the distances at which limbs are looked for, over √area
_LEAST = 0.1  # height of a limb, over √area: less is a bump
# Height of a limb over the radius of a disc with the perimeter of its base: 1 of a flat disc, π/2
# of a hemisphere, and of a tube π times its length over its diameter.
_STEEP = 2.5


def limb_tips(vertices: np.ndarray, faces: np.ndarray, distance: np.ndarray) -> list[int]:
    """The tips of limbs, farthest first.

    A limb is a connected part of those points that lie beyond some distance from the seam, and is
    higher than 2.5 times the radius of a disc with the perimeter of its base.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        distance: (V,) geodesic ones from the seam, or infinite.
    """
    unit = float(np.sqrt(topology.face_areas(vertices, faces).sum()))
    pairs = topology.edges_of(faces).pairs
    known = np.where(np.isfinite(distance), distance, -1.0)
    tips: set[int] = set()
    for level in np.arange(_LEVEL * unit, known.max() - _LEAST * unit, _LEVEL * unit):
        beyond = known > level
        part = _parts(pairs[beyond[pairs].all(axis=1)], len(vertices))
        # the farthest vertex of each part comes first
        order = np.lexsort((-known, part))
        number, first = np.unique(part[order], return_index=True)
        tip = order[first]
        height = known[tip] - level
        perimeter = _perimeters(vertices, faces, known, level, part)[number]
        steep = 2 * np.pi * height > _STEEP * perimeter
        tips |= set(tip[beyond[tip] & steep & (height > _LEAST * unit) & (perimeter > 0)].tolist())
    return sorted(tips, key=lambda v: -known[v])


def _parts(pairs: np.ndarray, count: int) -> np.ndarray:
    """The number (V,) of the part of each vertex that edges (E, 2) join."""
    graph = csr_matrix((np.ones(len(pairs), dtype=bool), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def _perimeters(
    vertices: np.ndarray, faces: np.ndarray, distance: np.ndarray, level: float, part: np.ndarray
) -> np.ndarray:
    """Lengths of the level set of distances (V,) around each part, by its number."""
    beyond = distance[faces] > level
    crossed = beyond.any(axis=1) & ~beyond.all(axis=1)
    corner, beyond = faces[crossed], beyond[crossed]
    # the corner that is alone on its side comes first
    alone = np.where(beyond.sum(axis=1) == 1, beyond.argmax(axis=1), beyond.argmin(axis=1))
    a, b, c = (corner[np.arange(len(corner)), (alone + k) % 3] for k in range(3))
    ends = []
    for other in (b, c):
        share = (level - distance[a]) / (distance[other] - distance[a])
        ends.append(vertices[a] + share[:, None] * (vertices[other] - vertices[a]))
    length = np.linalg.norm(ends[0] - ends[1], axis=1)
    inside = np.where(distance[a] > level, a, b)
    return np.bincount(part[inside], weights=length, minlength=len(distance))
