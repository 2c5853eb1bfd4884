"""Vertices on R²/Γ moved one by one to where their triangles are least distorted.

The energy is that of :mod:`nsm.domains.orbifold.newton`. A step that would flip a triangle or not
lower the energy is shortened, or not made. Where a global step is held up by the worst triangle,
these steps are not.
"""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled
from nsm.domains.orbifold.stars import Stars

_TRIES, _SHORTER = 4, 0.35
_NEARER = 0.7  # how far a vertex that does not fit goes towards its target, each time
_PLACES = 3


def relax(
    uv: np.ndarray, lattice: np.ndarray, stars: Stars, seen: np.ndarray, held: np.ndarray
) -> None:
    """One Newton step of each of the stars' middles, one after the other, within uv (V, 2).

    Args:
        uv, lattice: (V, 2) and (2, 2).
        stars: their triangles.
        seen: (3F, 2, 3) of the lifts, see :func:`nsm.domains.orbifold.stars.seen`.
        held: (V,) mask of vertices that stay.
    """
    _relax(
        uv, lattice, stars.vertex, stars.start, stars.corners, stars.ring, stars.shape, seen, held
    )


def put_back(
    uv: np.ndarray,
    lattice: np.ndarray,
    stars: Stars,
    seen: np.ndarray,
    weights: np.ndarray,
    target: np.ndarray,
) -> np.ndarray:
    """Give the stars' middles places in uv (V, 2): the means of their rings, or as near to these
    from their targets as they flip nothing.

    Args:
        uv, lattice, stars, seen: as for :func:`relax`; no two of the middles are neighbours.
        weights: (M, 2) of the rings' vertices b and c; those of a star add up to one.
        target: (N,) a vertex of each ring.

    Returns:
        the numbers of the stars whose middle found no place.
    """
    arrays = stars.vertex, stars.start, stars.corners, stars.ring, stars.shape
    return np.flatnonzero(~_put_back(uv, lattice, *arrays, seen, weights, target))


@compiled
def _relax(
    uv: np.ndarray,
    lattice: np.ndarray,
    vertex: np.ndarray,
    start: np.ndarray,
    corners: np.ndarray,
    ring: np.ndarray,
    shape: np.ndarray,
    seen: np.ndarray,
    held: np.ndarray,
) -> None:
    forms = np.empty((_most(start), 8))
    for i in range(len(vertex)):
        v, first, count = vertex[i], start[i], start[i + 1] - start[i]
        if held[v]:
            continue
        _fill(forms, uv, lattice, corners, ring, shape, seen, first, count)
        here = uv[v, 0], uv[v, 1]
        energy, x, y = _newton(forms, count, here)
        if not (np.isfinite(x) and np.isfinite(y)):
            continue
        for _ in range(_TRIES):
            there = here[0] + x, here[1] + y
            if _energy(forms, count, there) < energy:
                uv[v, 0], uv[v, 1] = there
                break
            x, y = _SHORTER * x, _SHORTER * y


@compiled
def _put_back(
    uv: np.ndarray,
    lattice: np.ndarray,
    vertex: np.ndarray,
    start: np.ndarray,
    corners: np.ndarray,
    ring: np.ndarray,
    shape: np.ndarray,
    seen: np.ndarray,
    weights: np.ndarray,
    target: np.ndarray,
) -> np.ndarray:
    found = np.zeros(len(vertex), dtype=np.bool_)
    forms, rings = np.empty((_most(start), 8)), np.empty(4)
    for i in range(len(vertex)):
        first, count = start[i], start[i + 1] - start[i]
        _fill(forms, uv, lattice, corners, ring, shape, seen, first, count)
        x = y = 0.0
        for p in range(first, first + count):
            _ring(rings, uv, lattice, ring[p], seen[corners[p]])
            x += weights[p, 0] * rings[0] + weights[p, 1] * rings[2]
            y += weights[p, 0] * rings[1] + weights[p, 1] * rings[3]
        from_x, from_y = uv[target[i], 0], uv[target[i], 1]
        share = 1.0
        for _ in range(_PLACES):
            there = from_x + share * (x - from_x), from_y + share * (y - from_y)
            if np.isfinite(_energy(forms, count, there)):
                uv[vertex[i], 0], uv[vertex[i], 1] = there
                found[i] = True
                break
            share *= _NEARER
    return found


@compiled
def _most(start: np.ndarray) -> int:
    """Triangles of the largest star."""
    most = 0
    for i in range(len(start) - 1):
        most = max(most, start[i + 1] - start[i])
    return most


@compiled
def _ring(
    places: np.ndarray, uv: np.ndarray, lattice: np.ndarray, ring: np.ndarray, seen: np.ndarray
) -> None:
    """Where a triangle's vertices b and c, ring (2,), are in the lift of the star's middle: four
    coordinates."""
    for k in range(2):
        s, m, n = seen[k, 0], seen[k, 1], seen[k, 2]
        for i in range(2):
            shift = lattice[i, 0] * m + lattice[i, 1] * n
            places[2 * k + i] = s * uv[ring[k], i] + shift


@compiled
def _fill(
    forms: np.ndarray,
    uv: np.ndarray,
    lattice: np.ndarray,
    corners: np.ndarray,
    ring: np.ndarray,
    shape: np.ndarray,
    seen: np.ndarray,
    first: int,
    count: int,
) -> None:
    """What the energies of a star's triangles need, (K, 8): the place of b, the gradient n of det J
    by the middle's place p, 2 e y and f |y|² with y = c - b, and a: then with x = p - b, det J is
    n·x and A ‖J‖² is a |x|² + 2 e x·y + f |y|²."""
    rings = np.empty(4)
    for k in range(count):
        row = first + k
        _ring(rings, uv, lattice, ring[row], seen[corners[row]])
        y0, y1 = rings[2] - rings[0], rings[3] - rings[1]
        e, f, d = shape[row, 1], shape[row, 2], shape[row, 3]
        forms[k, 0], forms[k, 1] = rings[0], rings[1]
        forms[k, 2], forms[k, 3] = -y1 * d, y0 * d
        forms[k, 4], forms[k, 5] = 2 * e * y0, 2 * e * y1
        forms[k, 6] = f * (y0 * y0 + y1 * y1)
        forms[k, 7] = shape[row, 0]


@compiled
def _energy(forms: np.ndarray, count: int, here: tuple[float, float]) -> float:
    """Of a star with its middle here; inf where a triangle has no area."""
    total = 0.0
    for k in range(count):
        x, y = here[0] - forms[k, 0], here[1] - forms[k, 1]
        det = forms[k, 2] * x + forms[k, 3] * y
        if not det > 0:
            return np.inf
        norm = forms[k, 7] * (x * x + y * y) + (forms[k, 4] * x + forms[k, 5] * y) + forms[k, 6]
        total += norm * (1 + 1 / (det * det))
    return total


@compiled
def _newton(forms: np.ndarray, count: int, here: tuple[float, float]) -> tuple[float, float, float]:
    """Energy of a star with its middle here, and Newton's step, no triangle of which loses its area
    before 1.25 times the step."""
    energy = gx = gy = xx = yy = xy = 0.0
    for k in range(count):
        x, y = here[0] - forms[k, 0], here[1] - forms[k, 1]
        nx, ny, twice = forms[k, 2], forms[k, 3], 2 * forms[k, 7]
        det = nx * x + ny * y
        q = forms[k, 7] * (x * x + y * y) + (forms[k, 4] * x + forms[k, 5] * y) + forms[k, 6]
        by_x, by_y = twice * x + forms[k, 4], twice * y + forms[k, 5]  # of q
        power = 1 / (det * det)
        one = 1 + power
        change = -2 * power / det
        second = 6 * q * power * power
        energy += q * one
        gx += one * by_x + change * q * nx
        gy += one * by_y + change * q * ny
        xx += twice * one + (2 * change * by_x + second * nx) * nx
        yy += twice * one + (2 * change * by_y + second * ny) * ny
        xy += change * by_x * ny + (change * by_y + second * ny) * nx
    # λ I is added where the lower eigenvalue is not clearly above zero
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = np.sqrt(half * half + xy * xy)
    shift = max(0.05 * (abs(mean) + radius) - (mean - radius), 0.0)
    xx, yy = xx + shift, yy + shift
    det = xx * yy - xy * xy
    x, y = (xy * gy - yy * gx) / det, (xy * gx - xx * gy) / det
    rate = 1e-300
    for k in range(count):
        area = forms[k, 2] * (here[0] - forms[k, 0]) + forms[k, 3] * (here[1] - forms[k, 1])
        rate = max(rate, -(forms[k, 2] * x + forms[k, 3] * y) / area)
    size = min(1.0, 0.8 / rate)
    return energy, size * x, size * y
