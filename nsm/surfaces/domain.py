"""The planar domain Ω, the unit disc or the square [-1,1]^2: where a boundary loop lies on ∂Ω."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.errors import NsmError

DOMAINS = ("disc", "square")
DOMAIN_AREA = {"disc": float(np.pi), "square": 4.0}
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True)
class Keys:
    """Boundary vertices (K,) that are held at fractions (K,) in [0, 1) of the way around ∂Ω.

    Both run counter-clockwise, as the boundary loop does. On the disc a fraction t is the angle
    2πt; on the square the way starts at the corner (-1, -1), and corners are at quarters.
    """

    vertices: np.ndarray
    fractions: np.ndarray


def boundary_positions(
    vertices: np.ndarray,
    loop: np.ndarray,
    domain: str,
    name: str = "mesh",
    keys: Keys | None = None,
) -> np.ndarray:
    """Positions (B,2) of the boundary loop (B,) on the boundary of the domain, by arc length.

    On the square four vertices of the loop, near the quarters of its length, become the corners.
    With keys, arc length counts between neighbouring keys.
    """
    if keys is not None:
        return at_fractions(_fractions(vertices, loop, keys, domain), domain)
    points = vertices[loop]
    lengths = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    if domain == "disc":
        angle = 2 * np.pi * along[:-1] / along[-1]
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    count = len(loop)
    if count < 4:
        raise NsmError(f"{name}: the square domain needs four boundary vertices, not {count}")
    corners = [0]
    for quarter in (1, 2, 3):
        nearest = int(np.abs(along[:-1] - quarter * along[-1] / 4).argmin())
        # each side needs a vertex of its own, however uneven the boundary
        corners.append(min(max(nearest, corners[-1] + 1), count - 4 + quarter))
    result = np.empty((count, 2))
    for side, first in enumerate(corners):
        last = corners[side + 1] if side < 3 else count
        share = (along[first:last] - along[first]) / (along[last] - along[first])
        begin, end = _CORNERS[side], _CORNERS[(side + 1) % 4]
        result[first:last] = begin + share[:, None] * (end - begin)
    return result


def _fractions(vertices: np.ndarray, loop: np.ndarray, keys: Keys, domain: str) -> np.ndarray:
    """Fractions (B,) of the loop's vertices, by arc length between neighbouring keys."""
    place = {int(v): k for k, v in enumerate(loop)}
    stops = [place[int(v)] for v in keys.vertices]
    lengths = np.linalg.norm(vertices[np.roll(loop, -1)] - vertices[loop], axis=1)
    result = np.empty(len(loop))
    for k, first in enumerate(stops):
        last = stops[(k + 1) % len(stops)]
        count = (last - first) % len(loop) or len(loop)
        run = (first + np.arange(count)) % len(loop)
        along = np.concatenate([[0.0], np.cumsum(lengths[run])])
        begin = keys.fractions[k]
        span = (keys.fractions[(k + 1) % len(stops)] - begin) % 1.0 or 1.0
        result[run] = (begin + span * along[:-1] / along[-1]) % 1.0
    if domain == "square":  # a corner without a key takes the nearest vertex that is none
        free = np.setdiff1d(np.arange(len(loop)), stops)
        for corner in (0.0, 0.25, 0.5, 0.75):
            if np.isclose(result[stops], corner, atol=1e-12).any():
                continue
            gap = np.abs((result[free] - corner + 0.5) % 1.0 - 0.5)
            result[free[gap.argmin()]] = corner
    return result


def at_fractions(t: np.ndarray, domain: str) -> np.ndarray:
    """Points (B,2) of ∂Ω at fractions (B,) of the way around it (see :class:`Keys`)."""
    if domain == "disc":
        angle = 2 * np.pi * t
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    side = np.floor(4 * t).astype(int) % 4
    share = (4 * t - np.floor(4 * t))[:, None]
    return _CORNERS[side] + share * (_CORNERS[(side + 1) % 4] - _CORNERS[side])


def fractions_of(points: np.ndarray, domain: str) -> np.ndarray:
    """Fractions (B,) in [0, 1) of points (B,2) of ∂Ω: the inverse of :func:`at_fractions`."""
    u, v = points.T
    if domain == "disc":
        return (np.arctan2(v, u) / (2 * np.pi)) % 1.0
    sides = np.stack([-v, u, v, -u])  # each side is where one of these is 1
    along = np.stack([u, v, -u, -v])
    side = sides.argmax(axis=0)
    share = 0.5 * (along[side, np.arange(len(points))] + 1)
    return (0.25 * (side + share)) % 1.0
