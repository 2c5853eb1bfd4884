"""Points on a mesh made vertices of it, so that what takes vertices takes them as they are."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

_AT = 1e-6  # a barycentric coordinate below it is zero: the point is on an edge or at a corner


def with_points(
    vertices: np.ndarray, faces: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mesh with more vertices on its faces; its shape stays the same.

    A point inside a face splits it in three, one on an edge splits the faces at the edge in two,
    and one at a corner is that vertex. Vertices keep their numbers; new ones come after them.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        places: (L, 4) a face and barycentric coordinates of each point.

    Returns:
        vertices (V', 3), faces (F', 3), and the points as vertices (L,).
    """
    points = [*np.asarray(vertices, dtype=np.float64)]
    pieces = _Pieces(faces)
    ids = []
    for face, *weights in places.tolist():
        number, local = pieces.found(int(face), np.array(weights))
        inside = local > _AT
        corner = pieces.triangles[number]
        if inside.sum() == 1:
            ids.append(corner[int(local.argmax())])
            continue
        local = np.where(inside, local, 0.0) / local[inside].sum()
        ids.append(len(points))
        points.append(local @ np.stack([points[v] for v in corner]))
        if inside.all():
            pieces.split_face(number, ids[-1], local)
        else:
            k = int(np.flatnonzero(~inside)[0])
            ends = corner[(k + 1) % 3], corner[(k + 2) % 3]
            pieces.split_edge(*ends, ids[-1], local[(k + 1) % 3])
    return np.stack(points), np.array(pieces.triangles, dtype=np.int64), np.array(ids, np.int64)


class _Pieces:
    """Triangles and the faces that they are pieces of, with their corners' coordinates there."""

    def __init__(self, faces: np.ndarray) -> None:
        self.triangles: list[tuple[int, ...]] = [tuple(face) for face in faces.tolist()]
        self.corners: list[np.ndarray] = [np.eye(3)] * len(faces)
        self.face = list(range(len(faces)))
        self.of_face: dict[int, list[int]] = defaultdict(list)
        self.at: dict[int, set[int]] = defaultdict(set)  # triangles at each vertex
        for k, triangle in enumerate(self.triangles):
            self.of_face[k].append(k)
            for v in triangle:
                self.at[v].add(k)

    def found(self, face: int, weights: np.ndarray) -> tuple[int, np.ndarray]:
        """The piece of a face in which a point lies, and its coordinates (3,) there."""
        best, local = -1, np.full(3, -np.inf)
        for k in self.of_face[face]:
            found = np.linalg.solve(self.corners[k].T, weights)
            if found.min() > local.min():
                best, local = k, found
        return best, local

    def split_face(self, k: int, vertex: int, local: np.ndarray) -> None:
        a, b, c = self.triangles[k]
        p, q, r = self.corners[k]
        middle = local @ self.corners[k]
        self._replace(
            k,
            [
                ((a, b, vertex), (p, q, middle)),
                ((b, c, vertex), (q, r, middle)),
                ((c, a, vertex), (r, p, middle)),
            ],
        )

    def split_edge(self, a: int, b: int, vertex: int, share: float) -> None:
        """Split all triangles at the edge from a to b by a vertex ``share`` a + (1 - share) b."""
        for k in sorted(self.at[a] & self.at[b]):
            turn = next(t for t in range(3) if self.triangles[k][t] not in (a, b))
            c, first, second = (self.triangles[k][(turn + t) % 3] for t in range(3))
            r, p, q = (self.corners[k][(turn + t) % 3] for t in range(3))
            weight = share if first == a else 1 - share
            middle = weight * p + (1 - weight) * q
            self._replace(
                k,
                [((c, first, vertex), (r, p, middle)), ((c, vertex, second), (r, middle, q))],
            )

    def _replace(
        self, k: int, pieces: list[tuple[tuple[int, ...], tuple[np.ndarray, ...]]]
    ) -> None:
        for v in self.triangles[k]:
            self.at[v].discard(k)
        for n, (triangle, corners) in enumerate(pieces):
            number = k if n == 0 else len(self.triangles)
            if n:
                self.triangles.append(triangle)
                self.corners.append(np.stack(corners))
                self.face.append(self.face[k])
                self.of_face[self.face[k]].append(number)
            else:
                self.triangles[k], self.corners[k] = triangle, np.stack(corners)
            for v in triangle:
                self.at[v].add(number)
