"""libigl's SLIM (Rabinovich et al. 2017), in steps that let other threads and Ctrl-C through."""

from __future__ import annotations

import numpy as np

from nsm.stages import at

_SOFT = 1e5  # weight of vertices that are held


def slim(
    vertices: np.ndarray,
    faces: np.ndarray,
    start: np.ndarray,
    iterations: int,
    held: np.ndarray | None = None,
    places: np.ndarray | None = None,
) -> np.ndarray:
    """Lower the symmetric Dirichlet energy of a flat mesh.

    Args:
        vertices, faces: the mesh (V, 3), (F, 3).
        start: (V, 2), without flips.
        iterations: how many.
        held, places: vertices (B,) that are drawn softly to places (B, 2); none by default.

    Returns:
        (V, 2).

    Raises:
        RuntimeError: libigl's.
    """
    import igl

    free = held is None or places is None
    data = igl.slim_precompute(
        np.asfortranarray(vertices, dtype=np.float64),
        np.asfortranarray(faces, dtype=np.int32),
        np.asfortranarray(start, dtype=np.float64),
        igl.SYMMETRIC_DIRICHLET,
        np.zeros(0, dtype=np.int32) if held is None else held.astype(np.int32),
        np.asfortranarray(np.zeros((0, 2)) if places is None else places, dtype=np.float64),
        0.0 if free else _SOFT,
    )
    solved = start
    for k in range(iterations):  # one by one: libigl holds the interpreter meanwhile
        at("SLIM", k, iterations)
        solved = igl.slim_solve(data, 1)
    return np.array(solved)[:, :2]
