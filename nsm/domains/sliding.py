"""SLIM's steps (Rabinovich et al. 2017) with a boundary that slides along ∂Ω.

The boundary stays exactly on that of the domain, and no step that flips a triangle is taken, which
soft constraints cannot promise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix, diags

from nsm.domains.planar_mesh import flipped_triangles
from nsm.domains.tutte import factorise

if TYPE_CHECKING:
    from nsm.domains.base import BoundedDomain


def slide(
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    loop: np.ndarray,
    domain: BoundedDomain,
    steps: int,
    held: np.ndarray,
) -> np.ndarray:
    """SLIM steps from an injective uv (V,2), boundary vertices free to slide but for held (V,).

    Each step solves SLIM's weighted least-squares proxy in the remaining freedom (two coordinates
    inside, one along the boundary, none at the corners of the square), then searches along it for
    a lower symmetric Dirichlet energy without flips. Returns the last, lowest uv.
    """
    gradient, area = _gradients(vertices, faces)
    on_boundary = np.zeros(len(uv), dtype=bool)
    on_boundary[loop] = True
    inner = np.flatnonzero(~on_boundary)
    moving = loop[~held[loop]]
    energy = _energy(gradient, area, faces, uv)
    for _ in range(steps):
        direction = _proxy_step(gradient, area, faces, uv, inner, moving, domain)
        if direction is None:
            break
        # full steps flip triangles while some are needles: start short of the first to collapse
        step = min(1.0, 0.8 * _collapse_step(uv, direction, faces, inner, moving, domain))
        improved = False
        for _ in range(14):
            trial = _move(uv, direction, step, inner, moving, domain)
            value = _energy(gradient, area, faces, trial)
            if value < energy and _goes_round(trial[loop]):
                improved = True
                break
            step *= 0.6
        if not improved:
            break
        gain = (energy - value) / energy
        uv, energy = trial, value
        if gain < 1e-5:
            break
    return uv


def _gradients(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hat function gradients (F,3,2) in a frame of each triangle, and triangle areas (F,)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    length = np.linalg.norm(b - a, axis=1)
    x = (b - a) / length[:, None]
    cx = ((c - a) * x).sum(axis=1)
    cy = np.linalg.norm((c - a) - cx[:, None] * x, axis=1)
    # corners at (0,0), (length,0), (cx,cy): cy > 0 keeps the orientation of the surface
    double = length * cy
    rotated = np.stack(
        [
            np.stack([-cy, cx - length], axis=1),
            np.stack([cy, -cx], axis=1),
            np.stack([np.zeros_like(cy), length], axis=1),
        ],
        axis=1,
    )
    return rotated / double[:, None, None], 0.5 * double


def _jacobians(gradient: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> np.ndarray:
    return np.einsum("fki,fkj->fij", uv[faces], gradient)


def _energy(gradient: np.ndarray, area: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> float:
    """Area-weighted symmetric Dirichlet energy of the map to the plane; inf with any flip."""
    if flipped_triangles(uv, faces):
        return float("inf")
    jacobian = _jacobians(gradient, faces, uv)
    determinant = np.linalg.det(jacobian)
    if (determinant <= 0).any():
        return float("inf")
    norm = (jacobian**2).sum(axis=(1, 2))
    return float((area * norm * (1 + 1 / determinant**2)).sum())


def _proxy_step(
    gradient: np.ndarray,
    area: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    inner: np.ndarray,
    moving: np.ndarray,
    domain: BoundedDomain,
) -> np.ndarray | None:
    """Minimiser of the proxy: steps of inner vertices (2 each, x then y), then of moving ones."""
    u, s, vt = np.linalg.svd(_jacobians(gradient, faces, uv))
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    s = s.clip(1e-14)
    u[:, :, 1] *= sign[:, None]
    rotation = u @ vt
    # weights that give the proxy the gradient of s^2 + s^-2 at this point (limit 2 at s = 1)
    # without an upper bound: cut off, the weights of needles would no longer point downhill
    near = np.abs(s - 1) < 1e-6
    weight2 = np.where(near, 4.0, (s - s**-3) / np.where(near, 1.0, s - 1)).clip(1e-8)
    w2 = np.einsum("fij,fj,fkj->fik", u, weight2, u) * area[:, None, None]
    # quadratic form in the displacement d: 1/2 d'Hd + g'd, residual (J - R) at d = 0
    residual = _jacobians(gradient, faces, uv) - rotation
    force = np.einsum("fij,fjl,fkl->fki", w2, residual, gradient)  # (F,3,2)
    dots = np.einsum("fki,fli->fkl", gradient, gradient)
    block = np.einsum("fkl,fij->fkilj", dots, w2).reshape(len(faces), 6, 6)
    n = len(uv)
    index = (faces[:, :, None] * 2 + np.arange(2)).reshape(-1, 6)
    rows = np.repeat(index, 6, axis=1).ravel()
    columns = np.tile(index, (1, 6)).ravel()
    hessian = coo_matrix((block.ravel(), (rows, columns)), shape=(2 * n, 2 * n)).tocsc()
    g = np.zeros(2 * n)
    np.add.at(g, index.ravel(), force.ravel())
    # columns of freedom: both coordinates inside, the tangent on the boundary
    tangent = domain.tangents(uv[moving])
    k, m = len(inner), len(moving)
    freedom = coo_matrix(
        (
            np.concatenate([np.ones(2 * k), tangent.ravel()]),
            (
                np.concatenate(
                    [2 * inner, 2 * inner + 1, np.repeat(2 * moving, 2) + np.tile([0, 1], m)]
                ),
                np.concatenate([np.arange(2 * k), 2 * k + np.repeat(np.arange(m), 2)]),
            ),
        ),
        shape=(2 * n, 2 * k + m),
    ).tocsc()
    reduced = (freedom.T @ hessian @ freedom).tocsc()
    # a whisper of damping: the disc may spin freely, which leaves the proxy singular
    reduced = reduced + diags(np.full(2 * k + m, 1e-9 * reduced.diagonal().mean()))
    try:
        result = -factorise(reduced).solve(freedom.T @ g)
    except RuntimeError:
        return None
    return result if np.isfinite(result).all() else None


def _collapse_step(
    uv: np.ndarray,
    direction: np.ndarray,
    faces: np.ndarray,
    inner: np.ndarray,
    moving: np.ndarray,
    domain: BoundedDomain,
) -> float:
    """The step at which the first triangle loses its area (Smith and Schaefer 2015), or inf.

    Arcs of the boundary count as their tangents, so the search may have to shorten it still.
    """
    k = len(inner)
    displacement = np.zeros_like(uv)
    displacement[inner] = direction[: 2 * k].reshape(2, k).T
    displacement[moving] = direction[2 * k :, None] * domain.tangents(uv[moving])
    a, b, c = (uv[faces[:, i]] for i in range(3))
    da, db, dc = (displacement[faces[:, i]] for i in range(3))
    # twice the area at step t is p t^2 + q t + r with r > 0
    p = _cross(db - da, dc - da)
    q = _cross(b - a, dc - da) + _cross(db - da, c - a)
    r = _cross(b - a, c - a)
    # the smallest positive root as 2r / (sqrt(q^2 - 4pr) - q), which is stable for small p
    discriminant = q**2 - 4 * p * r
    denominator = np.sqrt(discriminant.clip(0.0)) - q
    collapses = (discriminant >= 0) & (denominator > 0)
    if not collapses.any():
        return float("inf")
    return float((2 * r[collapses] / denominator[collapses]).min())


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def _move(
    uv: np.ndarray,
    direction: np.ndarray,
    step: float,
    inner: np.ndarray,
    moving: np.ndarray,
    domain: BoundedDomain,
) -> np.ndarray:
    k = len(inner)
    moved = uv.copy()
    moved[inner] += step * direction[: 2 * k].reshape(2, k).T
    moved[moving] = domain.slide(uv[moving], step * direction[2 * k :])
    return moved


def _goes_round(polygon: np.ndarray) -> bool:
    """Whether each side of a polygon (B,2) of ∂Ω runs counter-clockwise around the middle of Ω.

    A side over more than half of the circle would leave the middle out.
    """
    return bool((_cross(polygon, np.roll(polygon, -1, axis=0)) > 0).all())
