"""Compiled loops that read B-splines at points: see :mod:`nsm.maps.bsplines`."""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled

# what lies beyond the cells: nothing; the grid again; again and turned around; turned and negative
CLAMPED, PERIODIC, EVEN, ODD = range(4)
_MOST = 4  # rows along an axis that a point sees, of the highest degree


@compiled
def _weigh(t: float, rate: float, taps: tuple[int, ...], w: np.ndarray) -> None:
    """The weights (3, k) at offset t: of the value, of d/dx and of d²/dx², where t grows
    by ``rate`` as x by one."""
    s, twice = 1 - t, rate * rate
    if len(taps) == 3:
        w[0, 0], w[0, 1], w[0, 2] = 0.5 * s * s, 0.5 + t * s, 0.5 * t * t
        w[1, 0], w[1, 1], w[1, 2] = -s * rate, (1 - 2 * t) * rate, t * rate
        w[2, 0], w[2, 1], w[2, 2] = twice, -2 * twice, twice
    else:
        w[0, 0], w[0, 3] = s**3 / 6, t**3 / 6
        w[0, 1], w[0, 2] = (3 * t**3 - 6 * t**2 + 4) / 6, (3 * s**3 - 6 * s**2 + 4) / 6
        w[1, 0], w[1, 3] = -0.5 * s**2 * rate, 0.5 * t**2 * rate
        w[1, 1], w[1, 2] = (1.5 * t**2 - 2 * t) * rate, (2 * s - 1.5 * s**2) * rate
        w[2, 0], w[2, 1] = s * twice, (3 * t - 2) * twice
        w[2, 2], w[2, 3] = (3 * s - 2) * twice, t * twice


@compiled
def _see(
    u: float,
    v: float,
    n: int,
    m: int,
    half: float,
    taps: tuple[int, ...],
    symmetry: int,
    along: np.ndarray,
    w: np.ndarray,
) -> None:
    """What a point (u, v) sees: numbers ``along`` (2, k) of coefficients and weights ``w``
    (2, 3, k), along both axes."""
    sign = 1.0
    if symmetry != CLAMPED:
        u, v = u - 2 * np.floor(u * 0.5 + 0.5), v - 2 * np.floor(v * 0.5 + 0.5)
        if symmetry == EVEN and (v < 0 or (v == 0 and u < 0)):
            u, v, sign = -u, -v, -1.0
    for axis in range(2):
        size = n if axis == 0 else m
        rate = size / (2 * half)
        z = ((u if axis == 0 else v) + half) * rate
        cell = 0  # of points that are not numbers, too
        if z > 0:
            cell = int(z) if z < size else size - 1
        t, within = z - cell, 1.0
        if symmetry == CLAMPED and (t < 0 or t > 1):  # beyond the rim nothing changes
            t, within = 0.0 if t < 0 else 1.0, 0.0
        _weigh(t, within * rate * sign, taps, w[axis])
        for k in range(len(taps)):
            if symmetry == CLAMPED:
                along[axis, k] = cell + k
            else:
                i = cell + k - 1
                along[axis, k] = i + size if i < 0 else (i - size if i >= size else i)


@compiled
def _row(i: int, j: int, n: int, m: int, taps: tuple[int, ...], symmetry: int) -> int:
    """The row of coefficient (i, j); ~r for row r with the sign turned."""
    if symmetry == CLAMPED:
        return i * (m + len(taps) - 1) + j
    if symmetry == EVEN:
        upper = m // 2
        if j < upper:
            return (n - 1 - i) * upper + upper - 1 - j
        return i * upper + j - upper
    row = i * m + j
    if symmetry == ODD and row >= n * m // 2:
        return ~(n * m - 1 - row)
    return row


@compiled
def all_seen(
    x: np.ndarray,
    n: int,
    m: int,
    half: float,
    taps: tuple[int, ...],
    symmetry: int,
    rows: np.ndarray,
    weights: np.ndarray,
) -> None:
    """What points (N, 2) see: rows (N, k²), and weights (3, N, k²) in value and both tangents."""
    along, w = np.empty((2, _MOST), np.int64), np.empty((2, 3, _MOST))
    for p in range(len(x)):
        _see(x[p, 0], x[p, 1], n, m, half, taps, symmetry, along, w)
        for a in range(len(taps)):
            for b in range(len(taps)):
                k = a * len(taps) + b
                row, sign = _row(along[0, a], along[1, b], n, m, taps, symmetry), 1.0
                if row < 0:
                    row, sign = ~row, -1.0
                rows[p, k] = row
                weights[0, p, k] = sign * w[0, 0, a] * w[1, 0, b]
                weights[1, p, k] = sign * w[0, 1, a] * w[1, 0, b]
                weights[2, p, k] = sign * w[0, 0, a] * w[1, 1, b]


@compiled
def values(
    x: np.ndarray,
    table: np.ndarray,
    n: int,
    m: int,
    half: float,
    taps: tuple[int, ...],
    symmetry: int,
    out: np.ndarray,
    column: int,
) -> None:
    """Value, ∂u, ∂v, ∂uu, ∂uv, ∂vv at x (N, 2), as many as ``out`` (P, N, ·) has planes, from
    ``column`` on."""
    along, w = np.empty((2, _MOST), np.int64), np.empty((2, 3, _MOST))
    rows = np.empty((_MOST, _MOST), np.int64)
    planes, width = len(out), table.shape[1]
    for p in range(len(x)):
        _see(x[p, 0], x[p, 1], n, m, half, taps, symmetry, along, w)
        for a in range(len(taps)):
            for b in range(len(taps)):
                rows[a, b] = _row(along[0, a], along[1, b], n, m, taps, symmetry)
        for c in range(width):
            f = fu = fv = fuu = fuv = fvv = 0.0
            for a in range(len(taps)):
                value = slope = bend = 0.0
                for b in range(len(taps)):
                    row = rows[a, b]
                    entry = table[row, c] if row >= 0 else -table[~row, c]
                    value += w[1, 0, b] * entry
                    slope += w[1, 1, b] * entry
                    bend += w[1, 2, b] * entry
                f += w[0, 0, a] * value
                fu += w[0, 1, a] * value
                fv += w[0, 0, a] * slope
                fuu += w[0, 2, a] * value
                fuv += w[0, 1, a] * slope
                fvv += w[0, 0, a] * bend
            out[0, p, column + c] = f
            if planes > 1:
                out[1, p, column + c] = fu
                out[2, p, column + c] = fv
            if planes > 3:
                out[3, p, column + c] = fuu
                out[4, p, column + c] = fuv
                out[5, p, column + c] = fvv


@compiled
def by_table(
    x: np.ndarray,
    gradient: np.ndarray,
    n: int,
    m: int,
    half: float,
    taps: tuple[int, ...],
    symmetry: int,
    total: np.ndarray,
    column: int,
) -> None:
    """Add to ``total`` (rows, F) the gradient by the table, of one by the values (P, N, ·)."""
    along, w = np.empty((2, _MOST), np.int64), np.empty((2, 3, _MOST))
    planes, width = len(gradient), total.shape[1]
    for p in range(len(x)):
        _see(x[p, 0], x[p, 1], n, m, half, taps, symmetry, along, w)
        for a in range(len(taps)):
            for b in range(len(taps)):
                row, sign = _row(along[0, a], along[1, b], n, m, taps, symmetry), 1.0
                if row < 0:
                    row, sign = ~row, -1.0
                of_value = sign * w[0, 0, a] * w[1, 0, b]
                of_u, of_v = sign * w[0, 1, a] * w[1, 0, b], sign * w[0, 0, a] * w[1, 1, b]
                for c in range(width):
                    share = of_value * gradient[0, p, column + c]
                    if planes > 1:
                        share += of_u * gradient[1, p, column + c]
                        share += of_v * gradient[2, p, column + c]
                    total[row, c] += share


@compiled
def by_points(gradient: np.ndarray, derivatives: np.ndarray, out: np.ndarray) -> None:
    """The gradient (N, 2) by the points, of one by the values (P, N, F): P is 1 or 3;
    ``derivatives`` (2 or 5, N, F) are ∂u, ∂v, ∂uu, ∂uv, ∂vv there."""
    for p in range(gradient.shape[1]):
        by_u, by_v = 0.0, 0.0
        for c in range(gradient.shape[2]):
            by_u += gradient[0, p, c] * derivatives[0, p, c]
            by_v += gradient[0, p, c] * derivatives[1, p, c]
            if len(gradient) > 1:
                along, across = gradient[1, p, c], gradient[2, p, c]
                by_u += along * derivatives[2, p, c] + across * derivatives[3, p, c]
                by_v += along * derivatives[3, p, c] + across * derivatives[4, p, c]
        out[p, 0], out[p, 1] = by_u, by_v
