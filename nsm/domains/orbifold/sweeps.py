"""Vertices on R²/Γ moved one by one to where their triangles are least distorted.

The energy is that of :mod:`nsm.domains.orbifold.newton`. Vertices that are no neighbours move at
once; a step that would flip a triangle or not lower the energy is shortened, or not made. Where a
global step is held up by the worst triangle, these steps are not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nsm.domains.orbifold import group
from nsm.domains.orbifold.newton import hat_gradients
from nsm.domains.vertex_relaxation import colours
from nsm.surfaces import topology

_TRIES, _SHORTER = 4, 0.35


class Stars:
    """The triangles around some vertices, no two of which are neighbours.

    Args:
        vertices: (V, 3) the mesh, scaled to the domain's area.
        faces, lift: (F, 3) and (F, 3, 3).
        vertex: (N,) the stars' middles.
        corners: (M,) places 3f + k of them in the faces.
        star: (M,) which of the N each belongs to.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        lift: np.ndarray,
        vertex: np.ndarray,
        corners: np.ndarray,
        star: np.ndarray,
    ) -> None:
        face, k = corners // 3, corners % 3
        kb, kc = (k + 1) % 3, (k + 2) % 3
        self.vertex, self.star = vertex, star
        self.b, self.c = faces[face, kb], faces[face, kc]
        back = group.inverse(lift[face, k])
        self.of_b = group.compose(back, lift[face, kb])
        self.of_c = group.compose(back, lift[face, kc])
        gradients, area = hat_gradients(vertices, np.stack([vertex[star], self.b, self.c], axis=1))
        g, gc = gradients[:, 0], gradients[:, 2]
        self.a = (g * g).sum(axis=1) * area
        self.e = (g * gc).sum(axis=1) * area
        self.f = (gc * gc).sum(axis=1) * area
        self.d = 0.5 / area

    def chosen(self, keep: np.ndarray) -> Stars:
        """Those of the stars that a mask (N,) keeps."""
        corners = keep[self.star]
        new = object.__new__(Stars)
        new.vertex, new.star = self.vertex[keep], (np.cumsum(keep) - 1)[self.star[corners]]
        for name in ("b", "c", "of_b", "of_c", "a", "e", "f", "d"):
            setattr(new, name, getattr(self, name)[corners])
        return new

    def rings(self, uv: np.ndarray, lattice: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (M, 2) of b and c, each in the lift of the star's middle."""
        b = self.of_b[:, :1] * uv[self.b] + self.of_b[:, 1:] @ lattice.T
        c = self.of_c[:, :1] * uv[self.c] + self.of_c[:, 1:] @ lattice.T
        return b, c

    def energy(self, b: np.ndarray, c: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Energy (N,) of each star with its middle at (N, 2); inf where a triangle has no area."""
        x, y = (at[self.star] - b).T, (c - b).T
        det = (y[0] * x[1] - y[1] * x[0]) * self.d
        good = det > 0
        power = 1 / np.where(good, det, 1.0) ** 2
        return self._sum(np.where(good, self._dirichlet(x, y) * (1 + power), np.inf))

    def _dirichlet(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (
            self.a * (x[0] ** 2 + x[1] ** 2)
            + 2 * self.e * (x[0] * y[0] + x[1] * y[1])
            + self.f * (y[0] ** 2 + y[1] ** 2)
        )

    def _sum(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self.star, weights=values, minlength=len(self.vertex))

    def newton(self, b: np.ndarray, c: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energy (N,) with the middles at (N, 2), and Newton's steps (N, 2), no triangle of which
        loses its area before 1.25 times the step."""
        x, y = (at[self.star] - b).T, (c - b).T
        det = (y[0] * x[1] - y[1] * x[0]) * self.d
        q = self._dirichlet(x, y)
        p2 = 1 / det**2
        p3 = -2 * p2 / det
        q4 = 6 * q * p2**2
        qx, qy = (2 * (self.a * x[i] + self.e * y[i]) for i in range(2))
        nx, ny = -y[1] * self.d, y[0] * self.d
        one = 1 + p2
        gx, gy = self._sum(one * qx + p3 * q * nx), self._sum(one * qy + p3 * q * ny)
        round_ = 2 * self.a * one
        xx = self._sum(round_ + 2 * p3 * qx * nx + q4 * nx * nx)
        xy = self._sum(p3 * (qx * ny + qy * nx) + q4 * nx * ny)
        yy = self._sum(round_ + 2 * p3 * qy * ny + q4 * ny * ny)
        # λ I is added where the lower eigenvalue is not clearly above zero
        mean, radius = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
        shift = np.maximum(0.05 * (np.abs(mean) + radius) - (mean - radius), 0.0)
        xx, yy = xx + shift, yy + shift
        step = (
            -np.stack([yy * gx - xy * gy, xx * gy - xy * gx], axis=1) / (xx * yy - xy**2)[:, None]
        )
        change = (nx * step[self.star, 0] + ny * step[self.star, 1]) / det
        rate = np.zeros(len(self.vertex))
        np.maximum.at(rate, self.star, -change)
        step *= np.minimum(1.0, 0.8 / np.maximum(rate, 1e-300))[:, None]
        return self._sum(q * one), step


def relax(uv: np.ndarray, lattice: np.ndarray, stars: Stars) -> None:
    """One Newton step of each of the stars' middles, within uv (V, 2)."""
    b, c = stars.rings(uv, lattice)
    here = uv[stars.vertex]
    with np.errstate(all="ignore"):
        energy, step = stars.newton(b, c, here)
    active = np.isfinite(step).all(axis=1)
    if not active.all():
        corners = active[stars.star]
        stars, b, c, here = stars.chosen(active), b[corners], c[corners], here[active]
        energy, step = energy[active], step[active]
    for _ in range(_TRIES):
        if len(here) == 0:
            return
        trial = here + step
        better = stars.energy(b, c, trial) < energy
        uv[stars.vertex[better]] = trial[better]
        if better.all():
            return
        corners, left = ~better[stars.star], ~better
        stars, b, c, here = stars.chosen(left), b[corners], c[corners], here[left]
        energy, step = energy[left], _SHORTER * step[left]


def colour_classes(
    vertices: np.ndarray, faces: np.ndarray, lift: np.ndarray, held: np.ndarray
) -> Iterator[Stars]:
    """The stars of all vertices that the faces name and that are not held, no neighbours in one."""
    ids, local = topology.renumbered(faces, len(vertices))
    colour = colours(local[faces], len(ids))
    owner = faces.ravel()
    of_corner = np.where(held[owner], -1, colour[local[owner]])
    number = np.zeros(len(vertices), dtype=np.int64)
    for k in range(int(colour.max()) + 1):
        corners, members = np.flatnonzero(of_corner == k), ids[(colour == k) & ~held[ids]]
        number[members] = np.arange(len(members))
        yield Stars(vertices, faces, lift, members, corners, number[owner[corners]])
