"""Kernels of star-shaped polygons: the points that see all sides from within."""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np


def innermost(b: np.ndarray, c: np.ndarray, room: float = 1e-14) -> np.ndarray | None:
    """The point (2,) that sees all sides (K, 2) to (K, 2) of a ring, counter-clockwise, at the
    largest distance from the nearest; None if there is none with at least so much room."""
    middle = b.mean(axis=0)
    size = max(float((b.max(axis=0) - b.min(axis=0)).max()), 1e-300)
    b, side = (b - middle) / size, (c - b) / size
    length = np.maximum(np.sqrt((side * side).sum(axis=1)), 1e-300)
    normal = np.array([-side[:, 1], side[:, 0]]).T / length[:, None]
    # n_k p - r >= h_k: the best r is met with equality by three of the sides
    three = _threes(len(b))
    system = np.concatenate([normal, np.full((len(b), 1), -1.0)], axis=1)[three]
    height = (normal * b).sum(axis=1)
    good = np.abs(np.linalg.det(system)) > 1e-12
    if not good.any():
        return None
    found = np.linalg.solve(system[good], height[three[good]][:, :, None])[:, :, 0]
    slack = (found[:, :2] @ normal.T - height - found[:, 2:]).min(axis=1)
    radius = np.where(slack >= -1e-9 * np.abs(found[:, 2]), found[:, 2], -np.inf)
    best = int(radius.argmax())
    if not radius[best] * size >= room:
        return None
    return np.asarray(middle + size * found[best, :2])


@cache
def _threes(count: int) -> np.ndarray:
    """All sets (N, 3) of three of so many numbers."""
    return np.array(list(combinations(range(count), 3)))
