"""Stars of vertices on R²/Γ: their energy, and Newton's step for their middles."""

from __future__ import annotations

import numpy as np

from nsm.domains.orbifold import group
from nsm.surfaces import topology


def hats(
    vertices: np.ndarray, faces: np.ndarray, flattest: float = 1e-3
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of the corners' hat functions on a mesh (V, 3), (F, 3), and areas (F,).

    Triangles flatter than ``flattest``, height over length, get that height: nobody sees how the
    map distorts needles, and keeping their shape would cost digits.

    Returns:
        (x, y, z), (3, F): in a frame with the first corner at the origin and the second on the
        first axis, the second's gradient is (x, y), the third's (0, z), and all three add up to
        zero; and the areas.
    """
    # by coordinates: on a few hundred faces, each call of numpy counts
    a, b, c = vertices.T.take(faces.T, axis=1).transpose(1, 0, 2)
    u, v = b - a, c - a
    lu = np.sqrt((u * u).sum(axis=0))
    mean = max(float(lu.sum()) / max(len(lu), 1), 1e-300)
    lu = np.maximum(lu, 1e-9 * mean)
    along = (u * v).sum(axis=0) / lu
    cross = topology.cross_product(u, v)
    double = np.sqrt((cross * cross).sum(axis=0))
    longest = np.maximum(lu, np.sqrt((v * v).sum(axis=0)))
    double = np.maximum(double, flattest * longest**2)
    # the triangle (0, 0), (lu, 0), (along, double / lu)
    return np.array([1 / lu, -along / double, lu / double]), 0.5 * double


def seen(lift: np.ndarray) -> np.ndarray:
    """The lifts of a triangle's other two corners, seen from each corner.

    Args:
        lift: (F, 3, 3).

    Returns:
        (2, 3, 3F): sign and shift (s, m, n) of the corner after corner 3f + k, and of the one after
        that.
    """
    back = group.inverse(lift)
    both = np.array([group.compose(back, lift[:, turn]) for turn in ([1, 2, 0], [2, 0, 1])])
    return both.reshape(2, -1, 3).transpose(0, 2, 1).astype(np.float64, order="C")


class Stars:
    """The triangles around some vertices (N,), no two of which are neighbours.

    Args:
        vertices: (V, 3) the mesh, scaled to the domain's area.
        faces: (F, 3).
        vertex: (N,) the stars' middles.
        corners: (M,) places 3f + k of them in the faces.
        star: (M,) which of the N each belongs to.

    Attributes:
        vertex, corners, star: as given, the corners of a star after those of the one before.
        ring: (2, M) the triangles' other vertices b and c, counter-clockwise.
        shape: (4, M) of triangles on the mesh: a = |g|²A, e = g·g_c A, f = |g_c|²A, with the
            gradients g, g_c of hat functions and the area A, and d = 1 / 2A.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        vertex: np.ndarray,
        corners: np.ndarray,
        star: np.ndarray,
    ) -> None:
        order = np.argsort(star, kind="stable")
        self.vertex, self.corners, self.star = vertex, corners[order], star[order]
        self._start = np.searchsorted(self.star, np.arange(len(vertex)))
        face, k = self.corners // 3, self.corners % 3
        self.ring = np.array([faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]])
        (x, y, z), area = hats(vertices, np.stack([vertex[self.star], *self.ring], axis=1))
        w = y + z
        self.shape = np.array([(x * x + w * w) * area, -w * z * area, z * z * area, 0.5 / area])

    @property
    def d(self) -> np.ndarray:
        """(M,) 1 / 2A."""
        return self.shape[3]

    def chosen(self, keep: np.ndarray) -> tuple[Stars, np.ndarray]:
        """Those of the stars that a mask (N,) keeps, and which of their corners (M,) these have."""
        mine = np.flatnonzero(keep.take(self.star))
        new = object.__new__(Stars)
        new.vertex, new.corners = self.vertex[keep], self.corners[mine]
        new.star = (np.cumsum(keep) - 1)[self.star[mine]]
        new._start = np.searchsorted(new.star, np.arange(len(new.vertex)))
        new.ring, new.shape = self.ring.take(mine, axis=1), self.shape.take(mine, axis=1)
        return new, mine

    def split(self, ends: np.ndarray) -> list[Stars]:
        """The stars in parts, each up to one of the numbers."""
        parts, start = [], 0
        corner = np.append(self._start, len(self.corners))
        for end in ends.tolist():
            new, mine = object.__new__(Stars), slice(corner[start], corner[end])
            new.vertex, new.corners = self.vertex[start:end], self.corners[mine]
            new.star, new._start = self.star[mine] - start, self._start[start:end] - mine.start
            new.ring, new.shape = self.ring[:, mine], self.shape[:, mine]
            parts.append(new)
            start = end
        return parts

    def rings(self, seen: np.ndarray, uv: np.ndarray, lattice: np.ndarray) -> np.ndarray:
        """Places (2, 2, M) of b and c, by coordinates, each in the lift of the star's middle.

        Args:
            seen: (2, 3, M) the lifts of b and c as the middle sees them.
            uv, lattice: (V, 2) and (2, 2).
        """
        return seen[:, :1] * uv.T.take(self.ring, axis=1).transpose(1, 0, 2) + lattice @ seen[:, 1:]

    def forms(self, rings: np.ndarray) -> np.ndarray:
        """What the energies of triangles need of the places (2, 2, M) of b and c: (7, M), b itself,
        the gradient n of det J by the middle's place p, and 2 e y and f |y|² with y = c - b: then
        with x = p - b, det J is n·x and A ‖J‖² is a |x|² + 2 e x·y + f |y|²."""
        y = rings[1] - rings[0]
        _, e, f, d = self.shape
        forms = np.empty((7, len(self.star)))
        forms[:2] = rings[0]
        forms[2], forms[3] = -y[1] * d, y[0] * d
        forms[4:6] = 2 * e * y
        forms[6] = f * (y[0] * y[0] + y[1] * y[1])
        return forms

    def energy(self, forms: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Energy (N,) of each star with its middle at (2, N); inf where a triangle has no area."""
        det, norm, _ = self._jacobians(forms, at)
        good = det > 0
        det = np.where(good, det, 1.0)
        return self.sums(np.where(good, norm * (1 + 1 / (det * det)), np.inf))

    def _jacobians(
        self, forms: np.ndarray, at: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """det J and A ‖J‖² (M,), and x (2, M)."""
        x = at.take(self.star, axis=1) - forms[:2]
        squares, mixed = x * x, forms[2:6].reshape(2, 2, -1) * x
        square = self.shape[0] * (squares[0] + squares[1])
        det, along = mixed[:, 0] + mixed[:, 1]
        return det, square + along + forms[6], x

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums (..., N) over the corners of each star of values (..., M)."""
        return np.asarray(np.add.reduceat(values, self._start, axis=-1))

    def newton(self, forms: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energy (N,) with the middles at (2, N), and Newton's steps (2, N), no triangle of which
        loses its area before 1.25 times the step."""
        det, q, x = self._jacobians(forms, at)
        n, twice = forms[2:4], 2 * self.shape[0]
        by_x = twice * x + forms[4:6]  # of q
        power = 1 / (det * det)
        one = 1 + power
        first = -2 * power / det
        mixed, second = first * by_x, 6 * q * power * power * n
        parts = np.empty((6, len(det)))
        parts[0] = q * one
        parts[1:3] = one * by_x + first * q * n
        parts[3:5] = twice * one + (2 * mixed + second) * n
        parts[5] = mixed[0] * n[1] + (mixed[1] + second[1]) * n[0]
        energy, gx, gy, xx, yy, xy = self.sums(parts)
        # λ I is added where the lower eigenvalue is not clearly above zero
        mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
        radius = np.sqrt(half * half + xy * xy)
        shift = np.maximum(0.05 * (np.abs(mean) + radius) - (mean - radius), 0.0)
        xx, yy = xx + shift, yy + shift
        step = np.array([xy * gy - yy * gx, xy * gx - xx * gy]) / (xx * yy - xy * xy)
        change = n * step.take(self.star, axis=1)
        rate = np.maximum.reduceat(-(change[0] + change[1]) / det, self._start)
        step *= np.minimum(1.0, 0.8 / np.maximum(rate, 1e-300))
        return energy, step
