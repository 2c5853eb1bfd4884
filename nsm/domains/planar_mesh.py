"""Flat meshes, uv (V,2) with faces (F,3): areas, distortion, and tests of injectivity."""

from __future__ import annotations

import numpy as np

from nsm.surfaces.predicates import orientation


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Signed areas (N,) of the parallelograms of vectors u and v (N,2)."""
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def signed_areas(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed areas (F,) of the triangles of a flat mesh (V,2)."""
    a, b, c = (uv[faces[:, k]] for k in range(3))
    return 0.5 * cross(b - a, c - a)


def symmetric_dirichlet(norm: np.ndarray, determinant: np.ndarray) -> np.ndarray:
    """‖J‖² + ‖J⁻¹‖² (N,) of maps in the plane, by ‖J‖² and det J (N,); inf unless det J > 0.

    Linear in ``norm``, which may come with a weight. For maps between meshes with the smoothing ε
    of METHOD Eq. 2 see :func:`nsm.surfaces.geometry.triangle_distortion`.
    """
    positive = determinant > 0
    return np.where(positive, norm * (1 + 1 / np.where(positive, determinant, 1.0) ** 2), np.inf)


def flipped_triangles(uv: np.ndarray, faces: np.ndarray) -> int:
    """Number of triangles whose signed area in the plane is not positive."""
    return int((~(signed_areas(uv, faces) > 0)).sum())


def boundary_self_intersections(uv: np.ndarray, loop: np.ndarray) -> int:
    """Number of pairs of sides of the closed polygon uv[loop] (B,2) that cross or touch.

    Neighbouring sides, which share a point, count only if they fold back.
    """
    p = uv[loop]
    q = np.roll(p, -1, axis=0)
    n = len(p)
    side = q - p
    following = np.roll(side, -1, axis=0)
    straight = orientation(p, q, np.roll(q, -1, axis=0)) == 0
    folded = straight & ((side * following).sum(axis=1) <= 0)
    total = int(folded.sum())
    low, high = np.minimum(p, q), np.maximum(p, q)
    for i in range(n - 2):
        last = n - 1 if i == 0 else n  # the last side is a neighbour of the first
        j = np.arange(i + 2, last)
        j = j[((low[j] <= high[i]) & (high[j] >= low[i])).all(axis=1)]
        if len(j) == 0:
            continue
        d1, d2 = orientation(p[i], q[i], p[j]), orientation(p[i], q[i], q[j])
        d3, d4 = orientation(p[j], q[j], p[i]), orientation(p[j], q[j], q[i])
        total += int(((d1 * d2 <= 0) & (d3 * d4 <= 0)).sum())
    return total


def flipped(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask (F,) of the triangles of a flat mesh (V, 2) that are not counter-clockwise, exactly."""
    a, b, c = (uv[faces[:, k]] for k in range(3))
    return orientation(a, b, c) <= 0


def order_violations(points: np.ndarray) -> int:
    """How often a closed polygon (B, 2) fails to go once around the origin, counter-clockwise.

    Zero, by exact signs, means that each side is seen counter-clockwise from the origin and that
    the turns add up to one: the polygon is then star-shaped, so it does not cross itself.
    """
    following = np.roll(points, -1, axis=0)
    backward = orientation(points, following, np.zeros(2)) <= 0
    angle = np.arctan2(points[:, 1], points[:, 0])
    turns = np.mod(np.roll(angle, -1) - angle, 2 * np.pi)[~backward].sum() / (2 * np.pi)
    return int(backward.sum()) or abs(round(turns) - 1)
