"""Geometric queries on meshes that results are measured with."""

from __future__ import annotations

import numpy as np


def subdivide(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split each triangle in four at its edges' middles: points (V, d), faces (F, 3) of the new."""
    import igl

    fine, fine_faces = igl.upsample(np.ascontiguousarray(points), faces, 1)
    return fine, np.asarray(fine_faces, dtype=np.int64)


def point_mesh_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distances (N,) from points (N, 3) to a mesh; infinite where either is not finite."""
    import igl

    if not (np.isfinite(points).all() and np.isfinite(vertices).all()):
        return np.full(len(points), np.inf)
    squared = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(vertices), faces
    )[0]
    return np.sqrt(np.maximum(squared, 0))
