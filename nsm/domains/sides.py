"""The sides of faces by the vertices that they belong to."""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled


@compiled
def ends_of_sides(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The other two vertices of each face of each of n vertices, in turn, so that what is inside is
    there twice: ends[start[v] : start[v + 1]].

    Args:
        faces: (F, 3).
        n: of the vertices.

    Returns:
        start (n + 1,), and ends (6F,).
    """
    start = np.zeros(n + 1, dtype=np.int64)
    for f in range(len(faces)):
        for k in range(3):
            start[faces[f, k] + 1] += 2
    for v in range(n):
        start[v + 1] += start[v]
    ends, place = np.empty(start[n], dtype=np.int64), start.copy()
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            ends[place[v]], ends[place[v] + 1] = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            place[v] += 2
    return start, ends
