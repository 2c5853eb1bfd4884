"""libigl's SLIM (Rabinovich et al. 2017), in steps that let other threads and Ctrl-C through."""

from __future__ import annotations

import numpy as np

from nsm.stages import at


def slim(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray, iterations: int) -> np.ndarray:
    """Lower the symmetric Dirichlet energy of a flat mesh, whose boundary is free.

    Args:
        vertices, faces: the mesh (V, 3), (F, 3).
        start: (V, 2), without flips.
        iterations: how many.

    Returns:
        (V, 2).

    Raises:
        RuntimeError: libigl's.
    """
    import igl

    data = igl.slim_precompute(
        np.asfortranarray(vertices, dtype=np.float64),
        np.asfortranarray(faces, dtype=np.int32),
        np.asfortranarray(start, dtype=np.float64),
        igl.SYMMETRIC_DIRICHLET,
        np.zeros(0, dtype=np.int32),  # none is drawn to a place
        np.zeros((0, 2), order="F"),
        0.0,
    )
    solved = start
    for k in range(iterations):  # one by one: libigl holds the interpreter meanwhile
        at("SLIM", k, iterations)
        solved = igl.slim_solve(data, 1)
    return np.array(solved)[:, :2]
