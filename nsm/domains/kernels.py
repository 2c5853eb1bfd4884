"""Kernels of star-shaped polygons: the points that see all sides from within."""

from __future__ import annotations

from itertools import combinations

import numpy as np


def innermost(b: np.ndarray, c: np.ndarray, room: float = 1e-14) -> np.ndarray | None:
    """The point (2,) that sees all sides (K, 2) to (K, 2) of a ring, counter-clockwise, at the
    largest distance from the nearest; None if there is none with at least so much room."""
    middle, size = b.mean(axis=0), max(float(np.ptp(b, axis=0).max()), 1e-300)
    b, side = (b - middle) / size, (c - b) / size
    normal = np.stack([-side[:, 1], side[:, 0]], axis=1)
    length = np.linalg.norm(normal, axis=1).clip(1e-300)
    normal /= length[:, None]
    # n_k p - r >= h_k: the best r is met with equality by three of the sides
    three = np.array(list(combinations(range(len(b)), 3)))
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
