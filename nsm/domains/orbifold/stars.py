"""Stars of vertices on R²/Γ: the triangles around them, and the shapes of these on the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.compiled import compiled


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
    others = lift[:, [[1, 2], [2, 0], [0, 1]]].astype(np.float64)
    others[..., 1:] -= lift[:, :, None, 1:]
    others *= lift[:, :, None, :1]
    return others.reshape(-1, 2, 3)


@compiled
def _stars(
    vertices: np.ndarray,
    faces: np.ndarray,
    scale: float,
    vertex: np.ndarray,
    corners: np.ndarray,
    star: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Start, corners, ring and shape, see :class:`Stars`."""
    count = len(corners)
    start, place = np.zeros(len(vertex) + 1, dtype=np.int64), np.empty(len(vertex), dtype=np.int64)
    for i in range(count):
        start[star[i] + 1] += 1
    for s in range(len(vertex)):
        place[s] = start[s]
        start[s + 1] += start[s]
    ordered, triangles = np.empty(count, dtype=np.int64), np.empty((count, 3), dtype=np.int64)
    ring, shape = np.empty((count, 2), dtype=np.int64), np.empty((count, 4))
    for i in range(count):
        at, f, k = place[star[i]], corners[i] // 3, corners[i] % 3
        place[star[i]] += 1
        ordered[at] = corners[i]
        ring[at, 0], ring[at, 1] = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
        triangles[at, 0], triangles[at, 1], triangles[at, 2] = (
            vertex[star[i]],
            ring[at, 0],
            ring[at, 1],
        )
    of_triangle, area = _hats(vertices, triangles, 1e-3)
    for i in range(count):
        x, z = of_triangle[i, 0], of_triangle[i, 2]
        w = of_triangle[i, 1] + z
        shape[i, 0], shape[i, 1] = (x * x + w * w) * area[i], -w * z * area[i]
        shape[i, 2], shape[i, 3] = z * z * area[i], 0.5 / (scale * area[i])
    return start, ordered, ring, shape


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
        return cls(vertex, *_stars(vertices, faces, scale, vertex, corners, star))

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
