"""Exact orientation of planar triangles."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

# Shewchuk 1997, "Adaptive precision floating-point arithmetic": the rounded determinant has the
# right sign if it exceeds (3 + 16ε)ε times the sum of the two products, ε = 2⁻⁵³
_BOUND = (3 + 16 * 2.0**-53) * 2.0**-53
_UNDERFLOW = 1e-300


def orientation(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Exact signs of the areas of triangles abc: 1 counter-clockwise, -1 clockwise, else 0.

    Where floating point does not decide, rational numbers do.

    Args:
        a, b, c: points (N, 2), or one point (2,) for all triangles.

    Returns:
        (N,) int; 0 also if a coordinate is not finite.
    """
    a, b, c = np.broadcast_arrays(*(np.asarray(p, dtype=np.float64) for p in (a, b, c)))
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        left = (a[:, 0] - c[:, 0]) * (b[:, 1] - c[:, 1])
        right = (a[:, 1] - c[:, 1]) * (b[:, 0] - c[:, 0])
        determinant = left - right
        certain = np.abs(determinant) > _BOUND * (np.abs(left) + np.abs(right)) + _UNDERFLOW
    sign = np.where(certain, np.sign(np.where(certain, determinant, 0.0)), 0).astype(np.int64)
    for k in np.flatnonzero(~certain).tolist():
        sign[k] = _exact_sign(a[k], b[k], c[k])
    return sign


def _exact_sign(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> int:
    if not np.isfinite([a, b, c]).all():
        return 0
    (ax, ay), (bx, by), (cx, cy) = ([Fraction(float(x)) for x in p] for p in (a, b, c))
    determinant = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return (determinant > 0) - (determinant < 0)
