"""The symmetry group of a flat orbifold or torus, and points moved by it.

An element (s, m, n) takes a point x, in coordinates of the lattice, to s x + (m, n). In the plane,
with the lattice's vectors as columns of a matrix L, it takes z = L x to s z + L (m, n). The
orbifold 2222 has s = ±1, the torus s = 1 only. Elements are integer arrays (..., 3).
"""

from __future__ import annotations

import numpy as np

IDENTITY = np.array([1, 0, 0])
# Fixed points of the four half-turns that the orbifold's domain [-1, 1] x [0, 1] has as corners,
# in coordinates of the lattice 2Z x 2Z, counter-clockwise.
CONES = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]])
# Lattice coordinates are rounded to multiples of this, so that lifting a point is exact: |x| < 32.
STEP = 2.0**-48


def identities(*shape: int) -> np.ndarray:
    """The identity (*shape, 3)."""
    return np.broadcast_to(IDENTITY, (*shape, 3)).copy()


def compose(g: np.ndarray, h: np.ndarray) -> np.ndarray:
    """The elements (..., 3) that apply h first, then g."""
    sign = g[..., :1]
    return np.concatenate([sign * h[..., :1], sign * h[..., 1:] + g[..., 1:]], axis=-1)


def inverse(g: np.ndarray) -> np.ndarray:
    """The inverses (..., 3) of elements."""
    return np.concatenate([g[..., :1], -g[..., :1] * g[..., 1:]], axis=-1)


def moved(g: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Points x (..., 2), in coordinates of the lattice, moved by elements (..., 3)."""
    return g[..., :1] * x + g[..., 1:]


def half_turn(cone: np.ndarray) -> np.ndarray:
    """The elements (..., 3) that turn the plane by π about cones (..., 2), half lattice points."""
    twice = np.rint(2 * np.asarray(cone)).astype(np.int64)
    return np.concatenate([np.full((*twice.shape[:-1], 1), -1), twice], axis=-1)


def rounded(x: np.ndarray) -> np.ndarray:
    """Lattice coordinates rounded so that :func:`moved` is exact in double precision."""
    return np.rint(x / STEP) * STEP


def into_domain(x: np.ndarray, symmetric: bool) -> tuple[np.ndarray, np.ndarray]:
    """Points (V, 2) moved into the fundamental domain, and the elements (V, 3) that move them.

    The domain is [-½, ½) x [0, ½] if ``symmetric`` (the orbifold), else [-½, ½) x [-½, ½).
    """
    g = identities(len(x))
    if not symmetric:
        g[:, 1:] = -np.floor(x + 0.5).astype(np.int64)
        return moved(g, x), g
    g[:, 2] = -np.rint(x[:, 1]).astype(np.int64)  # second coordinate in [-½, ½]
    y = moved(g, x)
    below = y[:, 1] < 0
    g[below] = compose(np.array([-1, 0, 0]), g[below])
    y = moved(g, x)
    g[:, 1] += -np.floor(y[:, 0] + 0.5).astype(np.int64)
    return moved(g, x), g
