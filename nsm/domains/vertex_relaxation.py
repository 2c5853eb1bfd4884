"""Relaxation of a flat mesh, vertex by vertex, to less distorted triangles.

The energy is that of :mod:`nsm.domains.sliding`: symmetric Dirichlet, weighted by area on the
mesh. Vertices that are not neighbours move at once. A step that would flip a triangle or not lower
the energy is shortened, and in the end skipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.decimation import Rings
from nsm.domains.planar_mesh import cross, symmetric_dirichlet
from nsm.surfaces import topology

if TYPE_CHECKING:
    from nsm.domains.base import BoundedDomain

_TRIES, _SHORTER = 4, 0.35
_COLOURS = 64


@dataclass
class Stars:
    """The triangles around some vertices (N,), no two of which are neighbours.

    For each of M corners at them: star (M,), which vertex it belongs to; b and c (M,), the
    triangle's other vertices, counter-clockwise; and of its shape on the mesh, a = |g|²A,
    e = g·g_c A, f = |g_c|²A, with the gradients g, g_c of the hat functions and the area A, and
    d = 1 / 2A.
    """

    vertex: np.ndarray
    star: np.ndarray
    b: np.ndarray
    c: np.ndarray
    a: np.ndarray
    e: np.ndarray
    f: np.ndarray
    d: np.ndarray

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        vertex: np.ndarray,
        star: np.ndarray,
        b: np.ndarray,
        c: np.ndarray,
    ) -> Stars:
        """The stars' triangles (vertex[star], b, c) with their shapes in a mesh (V, 3)."""
        p, q, r = vertices[vertex[star]], vertices[b], vertices[c]
        u, v, w = q - p, r - p, r - q
        double = np.linalg.norm(np.cross(u, v), axis=1)
        # hat functions' gradients have the dots |w|² / 4A² and, between p and r, (u·w) / 4A²
        half = 0.5 / double
        return cls(
            vertex,
            star,
            b,
            c,
            (w * w).sum(axis=1) * half,
            (u * w).sum(axis=1) * half,
            (u * u).sum(axis=1) * half,
            1 / double,
        )

    def subset(self, keep: np.ndarray) -> Stars:
        """The stars that a mask (N,) keeps."""
        corners = keep[self.star]
        number = np.cumsum(keep) - 1
        parts = (getattr(self, name)[corners] for name in ("b", "c", "a", "e", "f", "d"))
        return Stars(self.vertex[keep], number[self.star[corners]], *parts)

    def energy(self, uv: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Energy (N,) of each star with its vertex at (N, 2); inf where a triangle has no area."""
        x, y = at[self.star] - uv[self.b], uv[self.c] - uv[self.b]
        return self._sum(symmetric_dirichlet(self._norm(x, y), cross(y, x) * self.d))

    def _norm(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """‖J‖² times the area on the mesh (M,), by the sides x = p - b, y = c - b (M, 2)."""
        return (
            self.a * (x * x).sum(axis=1)
            + 2 * self.e * (x * y).sum(axis=1)
            + self.f * (y * y).sum(axis=1)
        )

    def _sum(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.star, weights=values, minlength=len(self.vertex))

    def derivatives(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Energy (N,), gradient (N, 2) and second derivatives xx, xy, yy (N, 3) at uv (V, 2)."""
        x, y = uv[self.vertex[self.star]] - uv[self.b], uv[self.c] - uv[self.b]
        det = cross(y, x) * self.d
        q = self._norm(x, y)
        p2 = 1 / det**2
        p3 = -2 * p2 / det
        q4 = 6 * q * p2**2
        qx, qy = (2 * (self.a * x[:, i] + self.e * y[:, i]) for i in range(2))
        nx, ny = -y[:, 1] * self.d, y[:, 0] * self.d
        one = 1 + p2
        gradient = [one * g + p3 * q * n for g, n in ((qx, nx), (qy, ny))]
        round_ = 2 * self.a * one
        second = [
            round_ + 2 * p3 * qx * nx + q4 * nx * nx,
            p3 * (qx * ny + qy * nx) + q4 * nx * ny,
            round_ + 2 * p3 * qy * ny + q4 * ny * ny,
        ]
        return (
            self._sum(q * one),
            np.stack([self._sum(g) for g in gradient], axis=1),
            np.stack([self._sum(h) for h in second], axis=1),
        )


@dataclass(frozen=True)
class Freedom:
    """Where vertices may move: those of a mask (V,) along ∂Ω, held ones not at all, the others
    freely. Without a domain, none is on ∂Ω."""

    on_boundary: np.ndarray
    held: np.ndarray
    domain: BoundedDomain | None = None

    @classmethod
    def whole(cls, count: int) -> Freedom:
        """That of so many vertices, which may all move freely."""
        none = np.zeros(count, dtype=bool)
        return cls(none, none)

    def retract(self, points: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Points (N, 2), changed in place: those of a mask (N,) are brought back to ∂Ω."""
        if self.domain is not None:
            points[which] = self.domain.retract(points[which])
        return points


def relax(uv: np.ndarray, stars: Stars, freedom: Freedom) -> None:
    """One Newton step of each of the stars' vertices, within uv (V, 2)."""
    energy, gradient, second = stars.derivatives(uv)
    on_boundary, here = freedom.on_boundary[stars.vertex], uv[stars.vertex]
    direction = _newton(gradient, second)
    if freedom.domain is not None and on_boundary.any():
        place, g, h = here[on_boundary], gradient[on_boundary], second[on_boundary]
        t = freedom.domain.tangents(place)
        along = (g * t).sum(axis=1)
        bend = h[:, 0] * t[:, 0] ** 2 + 2 * h[:, 1] * t[:, 0] * t[:, 1] + h[:, 2] * t[:, 1] ** 2
        bend = bend + (g * freedom.domain.curvature(place)).sum(axis=1)
        bend = np.maximum(bend, 0.1 * np.abs(h[:, 0] + h[:, 2]))
        direction[on_boundary] = -(along / bend)[:, None] * t
    size = np.minimum(1.0, 0.8 * _first_collapse(uv, stars, direction))
    active = np.isfinite(direction).all(axis=1) & ~freedom.held[stars.vertex]
    some, index = stars.subset(active), np.flatnonzero(active)
    for _ in range(_TRIES):
        if len(index) == 0:
            return
        trial = here[index] + size[index, None] * direction[index]
        trial = freedom.retract(trial, on_boundary[index])
        better = some.energy(uv, trial) < energy[index]
        uv[some.vertex[better]] = trial[better]
        size[index] *= _SHORTER
        some, index = some.subset(~better), index[~better]


def _newton(gradient: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Steps (N, 2) of Newton's method, with eigenvalues of 2×2 matrices made positive."""
    xx, xy, yy = second.T
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = np.hypot(half, xy)
    low = mean - radius
    # λ I added where the lower eigenvalue is not clearly above zero
    shift = np.maximum(0.05 * (np.abs(mean) + radius) - low, 0.0)
    xx, yy = xx + shift, yy + shift
    determinant = xx * yy - xy**2
    gx, gy = gradient.T
    return -np.stack([yy * gx - xy * gy, xx * gy - xy * gx], axis=1) / determinant[:, None]


def _first_collapse(uv: np.ndarray, stars: Stars, direction: np.ndarray) -> np.ndarray:
    """The multiple (N,) of each step (N, 2) at which a triangle of the star loses its area."""
    x, y = uv[stars.vertex[stars.star]] - uv[stars.b], uv[stars.c] - uv[stars.b]
    area = cross(y, x)
    by = direction[stars.star]
    change = cross(y, by)
    rate = np.zeros(len(stars.vertex))
    np.maximum.at(rate, stars.star, -change / area)
    return 1 / np.maximum(rate, 1e-300)


def sweep(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, freedom: Freedom, sweeps: int
) -> None:
    """Relax all vertices that the faces (F, 3) name, one independent set after the other.

    Args:
        vertices: (V, 3) the mesh, which should have the area of the domain.
        uv: (V, 2), without flips; changed in place.
        sweeps: how many times every vertex is relaxed.
    """
    ids, local = topology.renumbered(faces, len(vertices))
    colour = colours(local[faces], len(ids))
    owner = faces.ravel()
    b, c = np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    of_corner = colour[local[owner]]
    number = np.zeros(len(vertices), dtype=np.int64)
    groups = []
    for k in range(int(colour.max()) + 1):
        mine, members = np.flatnonzero(of_corner == k), ids[colour == k]
        number[members] = np.arange(len(members))
        groups.append(Stars.of(vertices, members, number[owner[mine]], b[mine], c[mine]))
    for _ in range(sweeps):
        for stars in groups:
            relax(uv, stars, freedom)


def colours(faces: np.ndarray, n: int) -> np.ndarray:
    """Numbers (N,) that differ between neighbours."""
    rings, rng = Rings(faces, n), np.random.default_rng(0)
    colour = np.full(n, -1)
    for k in range(_COLOURS):
        free = colour < 0
        if not free.any():
            break
        colour[rings.apart(np.where(free, rng.uniform(size=n), np.inf), 1) & free] = k
    return colour
