"""Points on a triangle mesh: the nearest ones to given points, and values interpolated there."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple
from weakref import finalize

import numpy as np

_FAR = 1e6  # in sizes of the mesh
_LARGEST = 1e300
_CELLS = 32  # along each axis


class Places(NamedTuple):
    """Points on a mesh.

    Attributes:
        face: (N,) the face of each point; -1 where there is none.
        weights: (N, 3) its barycentric coordinates in that face; NaN where there is none.
    """

    face: np.ndarray
    weights: np.ndarray

    def take(self, values: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Values (V, ...) at the vertices, interpolated at the points: (N, ...); NaN where there is
        none."""
        corners = values[faces[self.face]]
        return np.einsum("nk,nk...->n...", self.weights, corners)

    def where(self, mask: np.ndarray, function: Callable[[Places], Places]) -> Places:
        """What a function makes of the places of a mask (N,); none for the others."""
        face, weights = np.full(len(mask), -1), np.full((len(mask), 3), np.nan)
        face[mask], weights[mask] = function(Places(self.face[mask], self.weights[mask]))
        return Places(face, weights)


class Locator:
    """A mesh, in the plane or in space, on which the nearest points to given ones are looked up.

    libigl's tree of its triangles is built once and serves all calls.

    Args:
        vertices: (V, d), d = 2 or 3.
        faces: (F, 3).
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        import igl

        self._vertices = _spatial(vertices)
        self._faces = np.ascontiguousarray(faces, dtype=np.int64)
        low, high = self._vertices.min(axis=0), self._vertices.max(axis=0)
        self._centre = 0.5 * (low + high)
        self._size = max(float((high - low).max()), 1e-300)
        tree = igl.AABB()
        tree.init(self._vertices, self._faces)
        self._tree = [tree]
        # also when Python ends: libigl's binding warns of trees that are alive then
        finalize(self, self._tree.clear)

    def __reduce__(self) -> tuple[type[Locator], tuple[np.ndarray, np.ndarray]]:
        return Locator, (self._vertices, self._faces)  # libigl's tree cannot be copied

    def locate(self, points: np.ndarray) -> Places:
        """The nearest points on the mesh to points (N, d)."""
        near = self._pulled_near(_spatial(points))
        order = self._by_cells(near)
        _, found, nearest = self._tree[0].squared_distance(self._vertices, self._faces, near[order])
        found = np.asarray(found, dtype=np.int64).reshape(-1)
        face, weights = np.empty(len(near), dtype=np.int64), np.empty((len(near), 3))
        face[order] = found
        weights[order] = _barycentric(np.asarray(nearest), self._vertices[self._faces[found]])
        return Places(face, weights)

    def _by_cells(self, points: np.ndarray) -> np.ndarray:
        """An order (N,) in which points (N, 3) of one cell of a grid follow each other: the parts
        of the tree that they visit are then in the processor's cache."""
        number = (points - self._centre) * (_CELLS / self._size) + 0.5 * _CELLS
        i, j, k = number.astype(np.int64).clip(0, _CELLS - 1).T
        return np.argsort((i * _CELLS + j) * _CELLS + k)

    def _pulled_near(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3), with those very far from the mesh moved straight towards its centre.

        Their nearest points do not change. Without it, squared distances would be equal or infinite
        after rounding, and libigl would return a face that does not exist.
        """
        offset = points.clip(-_LARGEST, _LARGEST) - self._centre
        reach = np.abs(offset).max(axis=1, keepdims=True, initial=0.0)
        limit = _FAR * self._size
        far = reach[:, 0] > limit
        if not far.any():
            return points
        result = points.copy()
        result[far] = self._centre + offset[far] * (limit / reach[far])
        return result


def locate(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Places:
    """The nearest point on a mesh to each given point, in the plane or in space.

    Args:
        points: (N, d), d = 2 or 3.
        vertices: (V, d).
        faces: (F, 3).
    """
    return Locator(vertices, faces).locate(points)


def _spatial(points: np.ndarray) -> np.ndarray:
    """Points (N, d) as points (N, 3), d = 2 or 3."""
    p = np.asarray(points, dtype=np.float64)
    return np.ascontiguousarray(np.pad(p, ((0, 0), (0, 3 - p.shape[1]))))


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (N, 3) of points (N, 3) in triangles (N, 3, 3), clipped to them."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = points - corners[:, 0]
    d11, d12, d22 = (e1 * e1).sum(1), (e1 * e2).sum(1), (e2 * e2).sum(1)
    p1, p2 = (p * e1).sum(1), (p * e2).sum(1)
    determinant = d11 * d22 - d12 * d12
    solvable = determinant > 1e-30 * np.maximum(d11 * d22, 1e-300)
    safe = np.where(solvable, determinant, 1.0)
    w1 = np.where(solvable, (d22 * p1 - d12 * p2) / safe, 0.0)
    w2 = np.where(solvable, (d11 * p2 - d12 * p1) / safe, 0.0)
    weights = np.clip(np.stack([1 - w1 - w2, w1, w2], axis=1), 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)
