"""Kernels of star-shaped polygons: the points that see all sides from within."""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled


def innermost(b: np.ndarray, c: np.ndarray, room: float = 1e-14) -> np.ndarray | None:
    """The point (2,) that sees all sides (K, 2) to (K, 2) of a ring, counter-clockwise, at the
    largest distance from the nearest; None if there is none with at least so much room."""
    x, y, radius = _innermost(np.ascontiguousarray(b), np.ascontiguousarray(c))
    return np.array([x, y]) if radius >= room else None


@compiled
def _innermost(b: np.ndarray, c: np.ndarray) -> tuple[float, float, float]:
    """See :func:`innermost`: the point, and its distance from the nearest side; -∞ for none."""
    count, size = len(b), 1e-300
    middle, normal, height = np.zeros(2), np.empty((count, 2)), np.empty(count)
    for i in range(2):
        low = high = b[0, i]
        for k in range(count):
            low, high = min(low, b[k, i]), max(high, b[k, i])
            middle[i] += b[k, i] / count
        size = max(size, high - low)
    for k in range(count):
        x, y = (c[k, 0] - b[k, 0]) / size, (c[k, 1] - b[k, 1]) / size
        length = max(np.sqrt(x * x + y * y), 1e-300)
        normal[k, 0], normal[k, 1] = -y / length, x / length
        x, y = (b[k, 0] - middle[0]) / size, (b[k, 1] - middle[1]) / size
        height[k] = normal[k, 0] * x + normal[k, 1] * y
    x, y, radius = _deepest(normal, height)
    return middle[0] + size * x, middle[1] + size * y, size * radius


@compiled
def _deepest(normal: np.ndarray, height: np.ndarray) -> tuple[float, float, float]:
    """The point p with the largest r such that n·p - r ≥ h for all normals n (K, 2) and heights h
    (K,), and r; -∞ if there is none."""
    found = 0.0, 0.0, -np.inf
    count = len(normal)
    # the best r is met with equality by three of the sides
    for i in range(count):
        for j in range(i):
            # differences of the three equations: two for p
            ax, ay = normal[j, 0] - normal[i, 0], normal[j, 1] - normal[i, 1]
            a = height[j] - height[i]
            for k in range(j):
                bx, by = normal[k, 0] - normal[i, 0], normal[k, 1] - normal[i, 1]
                b = height[k] - height[i]
                det = ax * by - ay * bx
                if not abs(det) > 1e-12:
                    continue
                x, y = (a * by - b * ay) / det, (ax * b - bx * a) / det
                radius = normal[i, 0] * x + normal[i, 1] * y - height[i]
                if not radius > found[2]:
                    continue
                least = -1e-9 * abs(radius)
                sees = True
                for s in range(count):
                    slack = normal[s, 0] * x + normal[s, 1] * y - height[s] - radius
                    if not slack >= least:
                        sees = False
                        break
                if sees:
                    found = x, y, radius
    return found
