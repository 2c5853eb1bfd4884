"""Tutte's embedding: injective for every mesh if the boundary is convex."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix, diags

from nsm.domains.positive_definite import factorise
from nsm.surfaces import topology


def tutte(
    vertices: np.ndarray,
    faces: np.ndarray,
    loop: np.ndarray,
    boundary: np.ndarray,
    *,
    weights: str = "uniform",
) -> np.ndarray:
    """Tutte's embedding (V,2): each inner vertex is a weighted mean of its neighbours.

    The boundary loop (B,) sits at boundary (B,2). weights: "uniform" or "mean_value"
    (Floater 2003); both are positive, so the embedding is injective in exact arithmetic.
    """
    n = len(vertices)
    if weights == "uniform":
        pairs = topology.edges_of(faces).pairs
        rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
        values = np.ones(len(rows))
    else:
        rows, columns, values = _mean_values(vertices, faces)
    matrix = csc_matrix((values, (rows, columns)), shape=(n, n))
    laplacian = (diags(np.asarray(matrix.sum(axis=1)).ravel()) - matrix).tocsr()
    inner = np.setdiff1d(np.arange(n), loop)
    uv = np.zeros((n, 2))
    uv[loop] = boundary
    if len(inner):
        right = -laplacian[inner][:, loop] @ boundary
        uv[inner] = factorise(laplacian[inner][:, inner].tocsc()).solve(right)
    return uv


def _mean_values(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, columns, values = [], [], []
    for k in range(3):
        i, j, m = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        a, b = vertices[j] - vertices[i], vertices[m] - vertices[i]
        la, lb = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
        sine = np.linalg.norm(np.cross(a, b), axis=1)
        half = sine / (la * lb + (a * b).sum(axis=1)).clip(1e-12)  # tan of half the angle
        half = half.clip(1e-6, 1e6)
        rows += [i, i]
        columns += [j, m]
        values += [half / la, half / lb]
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)
