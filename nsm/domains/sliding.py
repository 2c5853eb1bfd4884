"""SLIM's steps (Rabinovich et al. 2017) with a boundary that slides along ∂Ω.

The boundary stays exactly on that of the domain, and no step that flips a triangle is taken, which
soft constraints cannot promise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix, diags

from nsm.domains.planar_mesh import cross, flipped_triangles, symmetric_dirichlet
from nsm.domains.tutte import factorise
from nsm.stages import at

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
    inside, one along the boundary, none for held vertices), then searches along it for a lower
    symmetric Dirichlet energy without flips. Returns the last, lowest uv.
    """
    inner = np.setdiff1d(np.arange(len(uv)), loop)
    problem = _Problem(faces, *_gradients(vertices, faces), inner, loop[~held[loop]], domain)
    energy = problem.energy(uv)
    for k in range(steps):
        at("sliding along the boundary", k, steps)
        direction = problem.proxy_step(uv)
        if direction is None:
            break
        # full steps flip triangles while some are needles: start short of the first to collapse
        step = min(1.0, 0.8 * problem.collapse_step(uv, direction))
        improved = False
        for _ in range(14):
            trial = problem.moved(uv, step * direction)
            value = problem.energy(trial)
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


@dataclass(frozen=True)
class _Problem:
    """What all steps share.

    faces (F,3); gradient (F,3,2) and area (F,), see :func:`_gradients`; inner (I,) vertices, which
    move freely, and moving (M,) ones, which slide along ∂Ω. A direction (2I + M,) holds the x, then
    the y of the inner vertices' steps, then the lengths of the moving ones' along ∂Ω.
    """

    faces: np.ndarray
    gradient: np.ndarray
    area: np.ndarray
    inner: np.ndarray
    moving: np.ndarray
    domain: BoundedDomain

    def jacobians(self, uv: np.ndarray) -> np.ndarray:
        return np.einsum("fki,fkj->fij", uv[self.faces], self.gradient)

    def energy(self, uv: np.ndarray) -> float:
        """Area-weighted symmetric Dirichlet energy of the map to the plane; inf with any flip."""
        if flipped_triangles(uv, self.faces):
            return float("inf")
        jacobian = self.jacobians(uv)
        determinant = cross(jacobian[:, :, 0], jacobian[:, :, 1])
        norm = (jacobian**2).sum(axis=(1, 2))
        return float(symmetric_dirichlet(self.area * norm, determinant).sum())

    def proxy_step(self, uv: np.ndarray) -> np.ndarray | None:
        """The proxy's minimiser, a direction; None where the proxy cannot be solved."""
        faces, gradient, inner, moving = self.faces, self.gradient, self.inner, self.moving
        jacobian = self.jacobians(uv)
        u, s, vt = np.linalg.svd(jacobian)
        sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
        s = s.clip(1e-14)
        u[:, :, 1] *= sign[:, None]
        # weights that give the proxy the gradient of s^2 + s^-2 at this point (limit 2 at s = 1)
        # without an upper bound: cut off, the weights of needles would no longer point downhill
        near = np.abs(s - 1) < 1e-6
        weight2 = np.where(near, 4.0, (s - s**-3) / np.where(near, 1.0, s - 1)).clip(1e-8)
        w2 = np.einsum("fij,fj,fkj->fik", u, weight2, u) * self.area[:, None, None]
        # quadratic form in the displacement d: 1/2 d'Hd + g'd, residual (J - R) at d = 0
        force = np.einsum("fij,fjl,fkl->fki", w2, jacobian - u @ vt, gradient)  # (F,3,2)
        dots = np.einsum("fki,fli->fkl", gradient, gradient)
        block = np.einsum("fkl,fij->fkilj", dots, w2).reshape(len(faces), 6, 6)
        n = len(uv)
        index = (faces[:, :, None] * 2 + np.arange(2)).reshape(-1, 6)
        places = (np.repeat(index, 6, axis=1).ravel(), np.tile(index, (1, 6)).ravel())
        hessian = coo_matrix((block.ravel(), places), shape=(2 * n, 2 * n)).tocsc()
        g = np.zeros(2 * n)
        np.add.at(g, index.ravel(), force.ravel())
        # columns of freedom: both coordinates inside, the tangent on the boundary
        k, m = len(inner), len(moving)
        values = [np.ones(2 * k), self.domain.tangents(uv[moving]).ravel()]
        rows = [2 * inner, 2 * inner + 1, np.repeat(2 * moving, 2) + np.tile([0, 1], m)]
        columns = [np.arange(2 * k), 2 * k + np.repeat(np.arange(m), 2)]
        freedom = coo_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
            shape=(2 * n, 2 * k + m),
        ).tocsc()
        reduced = (freedom.T @ hessian @ freedom).tocsc()
        # slight damping: the disc may spin freely, which leaves the proxy singular
        reduced = reduced + diags(np.full(2 * k + m, 1e-9 * reduced.diagonal().mean()))
        try:
            result = -factorise(reduced).solve(freedom.T @ g)
        except RuntimeError:
            return None
        return result if np.isfinite(result).all() else None

    def collapse_step(self, uv: np.ndarray, direction: np.ndarray) -> float:
        """The step at which the first triangle loses its area (Smith and Schaefer 2015), or inf.

        Arcs of the boundary count as their tangents, so the search may have to shorten it still.
        """
        k = 2 * len(self.inner)
        displacement = np.zeros_like(uv)
        displacement[self.inner] = direction[:k].reshape(2, -1).T
        displacement[self.moving] = direction[k:, None] * self.domain.tangents(uv[self.moving])
        a, b, c = (uv[self.faces[:, i]] for i in range(3))
        da, db, dc = (displacement[self.faces[:, i]] for i in range(3))
        # twice the area at step t is p t^2 + q t + r with r > 0
        p = cross(db - da, dc - da)
        q = cross(b - a, dc - da) + cross(db - da, c - a)
        r = cross(b - a, c - a)
        # the smallest positive root as 2r / (sqrt(q^2 - 4pr) - q), which is stable for small p
        discriminant = q**2 - 4 * p * r
        denominator = np.sqrt(discriminant.clip(0.0)) - q
        collapses = (discriminant >= 0) & (denominator > 0)
        return float((2 * r[collapses] / denominator[collapses]).min(initial=np.inf))

    def moved(self, uv: np.ndarray, step: np.ndarray) -> np.ndarray:
        """uv (V,2) after a step, of the form of a direction."""
        k = 2 * len(self.inner)
        result = uv.copy()
        result[self.inner] += step[:k].reshape(2, -1).T
        result[self.moving] = self.domain.slide(uv[self.moving], step[k:])
        return result


def _goes_round(polygon: np.ndarray) -> bool:
    """Whether each side of a polygon (B,2) of ∂Ω runs counter-clockwise around the middle of Ω.

    A side over more than half of the circle would leave the middle out.
    """
    return bool((cross(polygon, np.roll(polygon, -1, axis=0)) > 0).all())
