"""Stars of vertices on R²/Γ: the triangles around them, and the shapes of these on the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.compiled import compiled
from nsm.domains.orbifold import group


def hats(
    vertices: np.ndarray, faces: np.ndarray, flattest: float = 1e-3
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of the corners' hat functions on a mesh (V, 3), (F, 3), and areas (F,).

    Triangles flatter than ``flattest``, height over length, get that height: nobody sees how the
    map distorts needles, and keeping their shape would cost digits.

    Returns:
        (x, y, z), (F, 3): in a frame with the first corner at the origin and the second on the
        first axis, the second's gradient is (x, y), the third's (0, z), and all three add up to
        zero; and the areas.
    """
    return _hats(np.ascontiguousarray(vertices, dtype=np.float64), faces, flattest)


@compiled
def _hats(
    vertices: np.ndarray, faces: np.ndarray, flattest: float
) -> tuple[np.ndarray, np.ndarray]:
    count = len(faces)
    of_face, area = np.empty((count, 3)), np.empty(count)
    u, v = np.empty(3), np.empty(3)
    total = 0.0
    for f in range(count):
        square = 0.0
        for i in range(3):
            side = vertices[faces[f, 1], i] - vertices[faces[f, 0], i]
            square += side * side
        of_face[f, 0] = np.sqrt(square)
        total += of_face[f, 0]
    least = 1e-9 * max(total / max(count, 1), 1e-300)
    for f in range(count):
        dot = square = 0.0
        for i in range(3):
            u[i] = vertices[faces[f, 1], i] - vertices[faces[f, 0], i]
            v[i] = vertices[faces[f, 2], i] - vertices[faces[f, 0], i]
            dot += u[i] * v[i]
            square += v[i] * v[i]
        length = max(of_face[f, 0], least)
        x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        longest = max(length, np.sqrt(square))
        double = max(np.sqrt(x * x + y * y + z * z), flattest * longest * longest)
        # the triangle (0, 0), (length, 0), (dot / length, double / length)
        of_face[f, 0] = 1 / length
        of_face[f, 1] = -dot / length / double
        of_face[f, 2] = length / double
        area[f] = 0.5 * double
    return of_face, area


def seen(lift: np.ndarray) -> np.ndarray:
    """The lifts of a triangle's other two corners, seen from each corner.

    Args:
        lift: (F, 3, 3).

    Returns:
        (3F, 2, 3): sign and shift (s, m, n) of the corner after corner 3f + k, and of the one after
        that.
    """
    back = group.inverse(lift)
    both = [group.compose(back, lift[:, turn]) for turn in ([1, 2, 0], [2, 0, 1])]
    return np.stack(both, axis=2).reshape(-1, 2, 3).astype(np.float64)


@dataclass(frozen=True)
class Stars:
    """The triangles around some vertices (N,).

    Attributes:
        vertex: (N,) the stars' middles.
        start: (N + 1,) where their corners begin.
        corners: (M,) places 3f + k of the middles in the faces.
        ring: (M, 2) the triangles' other vertices b and c, counter-clockwise.
        shape: (M, 4) of triangles on the mesh: a = |g|²A, e = g·g_c A, f = |g_c|²A, with the
            gradients g, g_c of hat functions and the area A, and d = 1 / 2A.
    """

    vertex: np.ndarray
    start: np.ndarray
    corners: np.ndarray
    ring: np.ndarray
    shape: np.ndarray

    @classmethod
    def of(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        scale: float,
        vertex: np.ndarray,
        corners: np.ndarray,
        star: np.ndarray,
    ) -> Stars:
        """Those of some vertices of a mesh.

        Args:
            vertices: (V, 3).
            faces: (F, 3).
            scale: of areas, which makes that of the mesh the domain's.
            vertex: (N,) the stars' middles.
            corners: (M,) places 3f + k of them in the faces.
            star: (M,) which of the N each belongs to.
        """
        order = np.argsort(star, kind="stable")
        corners, star = corners[order], star[order]
        start = np.searchsorted(star, np.arange(len(vertex) + 1))
        face, k = corners // 3, corners % 3
        triangles = np.stack(
            [vertex[star], faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]], axis=1
        )
        of_triangle, area = hats(vertices, triangles)
        x, y, z = of_triangle.T
        w = y + z
        shape = np.stack(
            [(x * x + w * w) * area, -w * z * area, z * z * area, 0.5 / (scale * area)], axis=1
        )
        return cls(vertex, start, corners, np.ascontiguousarray(triangles[:, 1:]), shape)

    def ring_places(
        self, number: int, uv: np.ndarray, lattice: np.ndarray, seen: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Places (K, 2) of b and c around one star's middle, in its lift.

        Args:
            number: of the star.
            uv, lattice: (V, 2) and (2, 2).
            seen: (3F, 2, 3) of the lifts.
        """
        mine = slice(self.start[number], self.start[number + 1])
        lifts = seen[self.corners[mine]]
        places = lifts[:, :, :1] * uv[self.ring[mine]] + lifts[:, :, 1:] @ lattice.T
        return places[:, 0], places[:, 1]
