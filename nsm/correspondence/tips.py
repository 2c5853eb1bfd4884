"""Tips of a closed surface: ends of limbs, and points far from them.

An end of a limb is a maximum of the mean geodesic distance. Its prominence, the height above the
highest pass to a higher maximum (persistent homology of the superlevel sets), is about the limb's
length.
"""

from __future__ import annotations

import numpy as np

from nsm.correspondence.distances import edge_distances
from nsm.domains.orbifold.cones import decimated, extremities
from nsm.surfaces import topology

_FACES = 3000
_FINE = 8000  # where small limbs count
_SOURCES = 96  # of the mean distance
_LIMB = 0.1  # prominence, over √area
_SAME, _APART = 0.1, 0.2  # a tip that is nearer to another, over √area


def tips_of(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Up to ``count`` tips (K,) of a closed mesh (V, 3), (F, 3).

    They are the extremities. Those beside an end of a limb at which none is give way to it.
    """
    far = extremities(vertices, faces, count)
    coarse, ids = decimated(vertices, faces, _FACES, far)
    points = vertices[ids]
    root = float(np.sqrt(topology.face_areas(points, coarse).sum()))
    limbs = _maxima(points, coarse, _LIMB)[0]
    others = np.searchsorted(ids, far)
    apart = edge_distances(points, coarse, others)[:, limbs] / root
    missed = apart.min(axis=0) > _SAME
    near = (apart[:, missed] < _APART).any(axis=1)
    return ids[np.concatenate([others[~near], limbs[missed]])[:count]]


def limb_ends(
    vertices: np.ndarray, faces: np.ndarray, prominence: float
) -> tuple[np.ndarray, np.ndarray]:
    """Ends of limbs (S,) of a closed mesh (V, 3), (F, 3), and their prominences (S,) over √area.

    They are more prominent than ``prominence``; the most prominent come first.
    """
    coarse, ids = decimated(vertices, faces, _FINE)
    found, height = _maxima(vertices[ids], coarse, prominence)
    return ids[found], height


def _maxima(points: np.ndarray, faces: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Maxima (S,) of the mean distance, and their prominences (S,) over √area, if above ``least``;
    the most prominent come first."""
    area = topology.face_areas(points, faces)
    found, height = prominences(faces, mean_distances(points, faces, area) / np.sqrt(area.sum()))
    return found[height > least], height[height > least]


def mean_distances(vertices: np.ndarray, faces: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Mean geodesic distance (V,), along edges, to points of the surface.

    Args:
        vertices, faces: (V, 3) and (F, 3).
        area: (F,) of the faces.
    """
    corner = np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=len(vertices))
    # sources spread evenly, by farthest points; weighted by the area that is nearest to each
    rows = [edge_distances(vertices, faces, np.array([0]))[0]]
    nearest = rows[0]
    while len(rows) < min(_SOURCES, len(vertices)):
        rows.append(edge_distances(vertices, faces, nearest.argmax()[None])[0])
        nearest = np.minimum(nearest, rows[-1])
    table = np.stack(rows)
    weight = np.bincount(table.argmin(axis=0), corner, len(rows))
    return np.asarray(weight @ table / area.sum())


def prominences(faces: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local maxima (M,) of values (V,) on a connected mesh (F, 3), and their prominences (M,).

    The most prominent come first; the highest one's prominence is the range of all values.
    """
    ends = topology.edges_of(faces).pairs
    both = np.concatenate([ends, ends[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    first = np.searchsorted(both[:, 0], np.arange(len(values) + 1))
    peak = np.full(len(values), -1)  # a way to the maximum of the part that a vertex is in

    def top(v: int) -> int:
        while peak[v] != v:
            peak[v] = peak[peak[v]]
            v = int(peak[v])
        return v

    height = {int(values.argmax()): float(np.ptp(values))}
    for v in np.argsort(-values, kind="stable").tolist():
        around = both[first[v] : first[v + 1], 1]
        parts = sorted({top(int(u)) for u in around if peak[u] >= 0}, key=lambda u: -values[u])
        peak[v] = parts[0] if parts else v
        for lower in parts[1:]:  # a pass: all parts but the highest end here
            peak[lower] = parts[0]
            height[lower] = float(values[lower] - values[v])
    found = sorted(height, key=lambda u: -height[u])
    return np.array(found, dtype=np.int64), np.array([height[u] for u in found])
