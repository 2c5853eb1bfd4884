"""Tutte embeddings of closed surfaces into R²/Γ: one sparse symmetric solve, bijective.

Aigerman and Lipman 2015, "Orbifold Tutte embeddings"; for the torus Gortler, Gotsman and Thurston
2006, "Discrete one-forms on meshes". Weights are positive, so no triangle flips. In coordinates of
the lattice the solution does not depend on the lattice's shape.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from nsm.domains.orbifold import group
from nsm.errors import NsmError

WEIGHTS = ("mean_value", "uniform", "cotangent")
_LEAST = 1e-3  # of a clamped weight, relative to the median
_FLATTEST = 1e-6  # tangents of half angles are kept between this and its inverse


def tutte(
    faces: np.ndarray, lift: np.ndarray, weights: np.ndarray, cones: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The embedding of least weighted squared edge length.

    Args:
        faces: (F, 3).
        lift: (F, 3, 3).
        weights: (F, 3) positive, of the edge from corner k to k + 1; the two faces' weights add up.
        cones: (4,) vertices held at the cones; None for a torus, where vertex faces[0, 0] is held
            at the origin.

    Returns:
        x (V, 2) in coordinates of the lattice, and the symmetric matrix Q (2, 2): the energy
        is tr(L Q Lᵀ) for a lattice with columns L.
    """
    n = int(faces.max()) + 1
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    gi, gj = lift.reshape(-1, 3), np.roll(lift, -1, axis=1).reshape(-1, 3)
    w = weights.ravel()
    # each edge: w |s_i x_i + t_i - s_j x_j - t_j|²
    cross = -w * gi[:, 0] * gj[:, 0]
    gap = gi[:, 1:] - gj[:, 1:]
    rows = np.concatenate([i, j, i, j])
    columns = np.concatenate([i, j, j, i])
    matrix = csc_matrix((np.concatenate([w, w, cross, cross]), (rows, columns)), shape=(n, n))
    force = np.stack(
        [
            np.bincount(j, weights=w * gj[:, 0] * gap[:, k], minlength=n)
            - np.bincount(i, weights=w * gi[:, 0] * gap[:, k], minlength=n)
            for k in range(2)
        ],
        axis=1,
    )
    x = np.zeros((n, 2))
    held = np.zeros(n, dtype=bool)
    held[np.setdiff1d(np.arange(n), faces)] = True
    if cones is None:
        held[faces[0, 0]] = True
    else:
        held[cones] = True
        x[cones] = group.CONES
    free = np.flatnonzero(~held)
    right = force[free] - matrix[free] @ x
    x[free] = _factorised(matrix[free][:, free].tocsc()).solve(right)
    edge = gi[:, :1] * x[i] - gj[:, :1] * x[j] + gap
    return x, (edge * w[:, None]).T @ edge


def _factorised(matrix: csc_matrix) -> SuperLU:
    """A factorisation of a symmetric positive definite matrix."""
    # supernodes are not enlarged: on meshes that costs more than it saves
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        relax=1,
        panel_size=4,
        options={"SymmetricMode": True},
    )


def edge_weights(vertices: np.ndarray, faces: np.ndarray, kind: str) -> np.ndarray:
    """Positive weights (F, 3) of the edges from corner k to k + 1.

    ``uniform``; ``mean_value``, Floater's (2003), made symmetric; or ``cotangent``, with negative
    ones clamped.
    """
    if kind == "uniform":
        return np.ones(faces.shape)
    side = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, -1, axis=1)], axis=2)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    double = np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None]
    # at corner k, between the sides k and k - 1
    before = np.roll(side, 1, axis=1)
    opposite = np.roll(side, -1, axis=1)
    dot = 0.5 * (side**2 + before**2 - opposite**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        if kind == "mean_value":
            half = double / (side * before + dot)  # tangent of half the angle
            half = np.nan_to_num(half, nan=1.0, posinf=1.0).clip(_FLATTEST, 1 / _FLATTEST)
            long = np.maximum(side, _FLATTEST * side.mean())
            return (half + np.roll(half, -1, axis=1)) / long
        if kind == "cotangent":
            cotangent = np.nan_to_num(dot / double, nan=0.0, posinf=1e6, neginf=-1e6)
            weight = np.roll(cotangent, -2, axis=1)  # of the corner opposite the side
            return np.maximum(weight, _LEAST * np.median(np.abs(weight)))
    raise NsmError(
        f"unknown weights {kind!r}; use one of {', '.join(WEIGHTS)}", kind="unknown_option"
    )


def best_lattice(quadratic: np.ndarray, area: float) -> np.ndarray:
    """The lattice L (2, 2), with determinant ``area``, of least tr(L Q Lᵀ).

    The first vector lies on the first axis, to its right.
    """
    value, vector = np.linalg.eigh(quadratic)
    root = vector @ np.diag(value**-0.5) @ vector.T
    return upright(root * np.sqrt(area / np.linalg.det(root)))


def upright(lattice: np.ndarray) -> np.ndarray:
    """The lattice (2, 2) turned so that its first vector lies on the first axis."""
    a, b = lattice[:, 0]
    length = np.hypot(a, b)
    turned = np.array([[a, b], [-b, a]]) / length @ lattice
    turned[1, 0] = 0.0
    return turned
