"""Canonical coordinates of a mesh's vertices, chosen so that collapses leave the lifts as they are.

A vertex' canonical coordinate may be that of any of its lifts. Where a vertex and the one that it
is drawn into have the same lift in the triangles that they share, a corner of the one becomes a
corner of the other without another lift.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsm.compiled import compiled
from nsm.domains.decimation import Round
from nsm.domains.orbifold import group


def regauged(faces: np.ndarray, lift: np.ndarray, rounds: Sequence[Round]) -> np.ndarray:
    """Lifts (F, 3, 3) with canonical coordinates such that a vertex and the one that it is drawn
    into have the same lift in the triangles they share.

    Args:
        faces: (F, 3).
        lift: (F, 3, 3).
        rounds: of collapses.
    """
    count = int(faces.max()) + 1
    gauge, into, current = group.identities(count), np.full(count, -1), faces.copy()
    for step in rounds:
        arrays = step.vertex, step.target, step.corners, step.star
        _regauge(faces, lift, gauge, into, current, *arrays)
    for step in reversed(rounds):
        gauge[step.vertex] = group.compose(gauge[step.target], gauge[step.vertex])
    return group.compose(lift, group.inverse(gauge[faces]))


@compiled
def _regauge(
    faces: np.ndarray,
    lift: np.ndarray,
    gauge: np.ndarray,
    into: np.ndarray,
    current: np.ndarray,
    vertex: np.ndarray,
    target: np.ndarray,
    corners: np.ndarray,
    star: np.ndarray,
) -> None:
    """Find what moves the canonical coordinates of the vertices of a round, and do its collapses.

    Args:
        gauge, into: (V, 3), (V,) of vertices that are collapsed, what moves their coordinates, and
            what they were drawn into; -1 for others.
        current: (F, 3) the faces as they are after the rounds before.
    """
    for i in range(len(corners)):
        f, k = corners[i] // 3, corners[i] % 3
        v, w = vertex[star[i]], target[star[i]]
        if into[v] < 0:
            for m in range(3):
                if current[f, m] == w:
                    s, x, y = _lift(faces, lift, gauge, into, f, k)
                    t, p, q = _lift(faces, lift, gauge, into, f, m)
                    gauge[v, 0], gauge[v, 1], gauge[v, 2] = t * s, t * (x - p), t * (y - q)
                    into[v] = w
    for i in range(len(corners)):
        current[corners[i] // 3, corners[i] % 3] = target[star[i]]


@compiled
def _lift(
    faces: np.ndarray, lift: np.ndarray, gauge: np.ndarray, into: np.ndarray, f: int, k: int
) -> tuple[int, int, int]:
    """That of a face's corner by its present canonical coordinates."""
    s, x, y = 1, 0, 0
    v = faces[f, k]
    while into[v] >= 0:
        t = gauge[v, 0]
        s, x, y = t * s, t * x + gauge[v, 1], t * y + gauge[v, 2]
        v = into[v]
    s *= lift[f, k, 0]
    return s, lift[f, k, 1] - s * x, lift[f, k, 2] - s * y
