"""SLIM's steps (Rabinovich et al. 2017) with a boundary that slides along ∂Ω.

The boundary stays exactly on that of the domain, and no step that flips a triangle is taken, which
soft constraints cannot promise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nsm.compiled import compiled
from nsm.domains.planar_mesh import cross
from nsm.domains.sparse_systems import Pattern
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
    problem = _Problem.of(vertices, faces, loop, held, domain)
    energy, gain = problem.energy(uv), np.inf
    for k in range(steps):
        at("SLIM", k, steps)
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
        before, gain = gain, (energy - value) / energy
        uv, energy = trial, value
        if max(before, gain) < 1e-5:  # a single step may be a short one
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

    faces (F,3); gradient (F,3,2) and area (F,), see :func:`_gradients`; moving (M,) vertices, which
    slide along ∂Ω. A direction (V, 2) holds the steps of inner vertices, and the lengths of the
    moving ones' along ∂Ω, with a zero; free (V, 2) is the mask of what is not zero.
    """

    faces: np.ndarray
    gradient: np.ndarray
    area: np.ndarray
    moving: np.ndarray
    free: np.ndarray
    pattern: Pattern
    domain: BoundedDomain

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        loop: np.ndarray,
        held: np.ndarray,
        domain: BoundedDomain,
    ) -> _Problem:
        """That of a mesh (V, 3), (F, 3) with a boundary loop; vertices of a mask (V,) stay."""
        moving, free = loop[~held[loop]], np.ones((len(vertices), 2), dtype=bool)
        free[loop] = False
        free[moving, 0] = True
        pattern = Pattern(faces, len(vertices))
        return cls(faces, *_gradients(vertices, faces), moving, free, pattern, domain)

    def energy(self, uv: np.ndarray) -> float:
        """Area-weighted symmetric Dirichlet energy of the map to the plane; inf with any flip."""
        return _energy(uv, self.faces, self.gradient, self.area)

    def tangents(self, uv: np.ndarray) -> np.ndarray:
        """The unit vectors (V, 2) in which first coordinates of directions count; second ones count
        to the left of these."""
        result = np.zeros_like(uv)
        result[:, 0] = 1.0
        result[self.moving] = self.domain.tangents(uv[self.moving])
        return result

    def proxy_step(self, uv: np.ndarray) -> np.ndarray | None:
        """The proxy's minimiser, a direction; None where the proxy cannot be solved."""
        pattern = self.pattern
        slope, panels = np.zeros((len(pattern.ids), 2)), np.zeros(pattern.size)
        _add_proxy(
            uv,
            self.faces,
            self.gradient,
            self.area,
            self.tangents(uv),
            self.free,
            pattern.corner,
            pattern.place,
            pattern.width,
            slope,
            panels,
        )
        solution = pattern.solution(panels, slope, ~self.free[pattern.ids])
        if solution is None or not np.isfinite(solution).all():
            return None
        direction = np.zeros_like(uv)
        direction[pattern.ids] = -solution
        return direction

    def collapse_step(self, uv: np.ndarray, direction: np.ndarray) -> float:
        """The step at which the first triangle loses its area (Smith and Schaefer 2015), or inf.

        Arcs of the boundary count as their tangents, so the search may have to shorten it still.
        """
        t = self.tangents(uv)
        left = np.stack([-t[:, 1], t[:, 0]], axis=1)
        return _collapse(uv, direction[:, :1] * t + direction[:, 1:] * left, self.faces)

    def moved(self, uv: np.ndarray, step: np.ndarray) -> np.ndarray:
        """uv (V,2) after a step, of the form of a direction."""
        result = uv + step
        result[self.moving] = self.domain.slide(uv[self.moving], step[self.moving, 0])
        return result


@compiled
def _energy(uv: np.ndarray, faces: np.ndarray, gradient: np.ndarray, area: np.ndarray) -> float:
    energy = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        side, other = uv[b, 0] - uv[a, 0], uv[c, 0] - uv[a, 0]
        if not side * (uv[c, 1] - uv[a, 1]) - other * (uv[b, 1] - uv[a, 1]) > 0:
            return np.inf
        xx, xy, yx, yy = _jacobian(uv, faces, gradient, f)
        det = xx * yy - xy * yx
        if not det > 0:
            return np.inf
        energy += area[f] * (xx * xx + xy * xy + yx * yx + yy * yy) * (1 + 1 / (det * det))
    return energy


@compiled
def _jacobian(
    uv: np.ndarray, faces: np.ndarray, gradient: np.ndarray, f: int
) -> tuple[float, float, float, float]:
    """That of a triangle, from its frame to the plane, row by row."""
    xx = xy = yx = yy = 0.0
    for k in range(3):
        u, v = uv[faces[f, k], 0], uv[faces[f, k], 1]
        xx, xy = xx + u * gradient[f, k, 0], xy + u * gradient[f, k, 1]
        yx, yy = yx + v * gradient[f, k, 0], yy + v * gradient[f, k, 1]
    return xx, xy, yx, yy


@compiled
def _add_proxy(
    uv: np.ndarray,
    faces: np.ndarray,
    gradient: np.ndarray,
    area: np.ndarray,
    tangent: np.ndarray,
    free: np.ndarray,
    corner: np.ndarray,
    place: np.ndarray,
    width: np.ndarray,
    slope: np.ndarray,
    panels: np.ndarray,
) -> None:
    """Add first and second derivatives of the proxy by directions; see :class:`Pattern` for the
    last five."""
    trace, count = 0.0, 0
    for f in range(len(faces)):
        xx, xy, yx, yy = _jacobian(uv, faces, gradient, f)
        # J = U Σ Vᵀ by the sum of a rotation and a reflection, both scaled
        e, h, g, k = 0.5 * (xx + yy), 0.5 * (yx - xy), 0.5 * (xx - yy), 0.5 * (yx + xy)
        rotation, reflection = np.sqrt(e * e + h * h), np.sqrt(g * g + k * k)
        large = max(rotation + reflection, 1e-14)
        small = max((xx * yy - xy * yx) / large, 1e-14)
        # weights that give the proxy the gradient of s² + s⁻² at this point: (s - s⁻³) / (s - 1),
        # without an upper bound: cut off, the weights of needles would no longer point downhill
        one, two = (
            1 + (1 + (1 + 1 / large) / large) / large,
            1 + (1 + (1 + 1 / small) / small) / small,
        )
        mean, half = 0.5 * area[f] * (one + two), 0.5 * area[f] * (one - two)
        # U's first column is at half the angle of the rotation and the reflection together
        length = max(rotation * reflection, 1e-300)
        cosine, sine = (e * g - h * k) / length, (e * k + h * g) / length
        a, b, c = mean + half * cosine, half * sine, mean - half * cosine
        # from the nearest rotation
        turn = max(rotation, 1e-300)
        xx, yy, xy, yx = xx - e / turn, yy - e / turn, xy + h / turn, yx - h / turn
        for m in range(3):
            v, x, y = faces[f, m], gradient[f, m, 0], gradient[f, m, 1]
            tx, ty = tangent[v, 0], tangent[v, 1]
            dx, dy = xx * x + xy * y, yx * x + yy * y
            fx, fy = a * dx + b * dy, b * dx + c * dy
            if free[v, 0]:
                slope[corner[f, m], 0] += tx * fx + ty * fy
            if free[v, 1]:
                slope[corner[f, m], 1] += tx * fy - ty * fx
            for n in range(3):
                at, w = place[f, m, n], faces[f, n]
                if at < 0:
                    continue
                dot = x * gradient[f, n, 0] + y * gradient[f, n, 1]
                sx, sy = tangent[w, 0], tangent[w, 1]
                for j in range(2):
                    if free[w, j]:
                        wx, wy = dot * (a * sx + b * sy), dot * (b * sx + c * sy)
                        for i in range(2):
                            if free[v, i]:
                                panels[at + j * width[f, n] + i] += (
                                    (tx * wx + ty * wy) if i == 0 else (tx * wy - ty * wx)
                                )
                    sx, sy = -sy, sx
    # slight damping: the disc may spin freely, which leaves the proxy singular
    for twice in range(2):
        done = np.zeros(len(slope), dtype=np.bool_)
        for f in range(len(faces)):
            for m in range(3):
                if not done[corner[f, m]]:
                    done[corner[f, m]] = True
                    for i in range(2):
                        if free[faces[f, m], i]:
                            at = place[f, m, m] + i * (width[f, m] + 1)
                            if twice == 0:
                                trace, count = trace + panels[at], count + 1
                            else:
                                panels[at] += 1e-9 * trace / count


@compiled
def _collapse(uv: np.ndarray, change: np.ndarray, faces: np.ndarray) -> float:
    first = np.inf
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, vx, vy = (
            uv[b, 0] - uv[a, 0],
            uv[b, 1] - uv[a, 1],
            uv[c, 0] - uv[a, 0],
            uv[c, 1] - uv[a, 1],
        )
        px, py = change[b, 0] - change[a, 0], change[b, 1] - change[a, 1]
        qx, qy = change[c, 0] - change[a, 0], change[c, 1] - change[a, 1]
        # twice the area at step t is p t^2 + q t + r with r > 0
        p, q, r = px * qy - py * qx, ux * qy - uy * qx + px * vy - py * vx, ux * vy - uy * vx
        # the smallest positive root as 2r / (sqrt(q^2 - 4pr) - q), which is stable for small p
        discriminant = q * q - 4 * p * r
        if discriminant >= 0:
            denominator = np.sqrt(discriminant) - q
            if denominator > 0:
                first = min(first, 2 * r / denominator)
    return first


def _goes_round(polygon: np.ndarray) -> bool:
    """Whether each side of a polygon (B,2) of ∂Ω runs counter-clockwise around the middle of Ω.

    A side over more than half of the circle would leave the middle out.
    """
    return bool((cross(polygon, np.roll(polygon, -1, axis=0)) > 0).all())
