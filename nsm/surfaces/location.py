"""From points to places on a triangulated surface, and back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_FAR = 1e6  # times the size of a mesh
_LARGEST = 1e300


class Places(NamedTuple):
    """Places on a mesh: the face (N,) and barycentric weights (N, 3) of its corners."""

    face: np.ndarray
    weights: np.ndarray

    def take(self, values: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Values (V, ...) at vertices, interpolated at the places: (N, ...)."""
        corners = values[faces[self.face]]
        return np.einsum("nk,nk...->n...", self.weights, corners)


def locate(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Places:
    """The nearest place on a mesh (V, d), (F, 3) for each point (N, d), in the plane or space.

    Points off the mesh go to the nearest place on it.
    """
    import igl

    def spatial(p: np.ndarray) -> np.ndarray:
        p = np.asarray(p, dtype=np.float64)
        return np.ascontiguousarray(np.pad(p, ((0, 0), (0, 3 - p.shape[1]))))

    mesh = spatial(vertices)
    near = _near(spatial(points), mesh)
    _, face, nearest = igl.point_mesh_squared_distance(near, mesh, faces)
    face = np.asarray(face, dtype=np.int64).reshape(-1)
    corners = mesh[faces[face]]
    return Places(face, _barycentric(np.asarray(nearest), corners))


def _near(points: np.ndarray, mesh: np.ndarray) -> np.ndarray:
    """Points (N, 3), those very far from a mesh (V, 3) drawn straight towards its middle.

    What is nearest stays so; the squares of their distances could not be told apart, or be
    infinite, and libigl would then name a face that is not there.
    """
    low, high = mesh.min(axis=0), mesh.max(axis=0)
    offset = points.clip(-_LARGEST, _LARGEST) - 0.5 * (low + high)
    limit = _FAR * max(float((high - low).max()), 1e-300)
    reach = np.abs(offset).max(axis=1, keepdims=True)
    far = reach[:, 0] > limit
    result = points.copy()
    result[far] = 0.5 * (low + high) + offset[far] * (limit / reach[far])
    return result


def _barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Weights (N, 3) of points (N, 3) in the planes of triangles (N, 3, 3), clipped to them."""
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
