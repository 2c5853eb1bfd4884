"""Geometric queries on meshes."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from nsm.surfaces.topology import edges_of

_DIRECTIONS = 200  # of rays for ambient occlusion


def subdivide(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (V, d) and faces (F, 3) of the mesh with each triangle split in four at midpoints."""
    import igl

    fine, fine_faces = igl.upsample(np.ascontiguousarray(points), faces, 1)
    return fine, np.asarray(fine_faces, dtype=np.int64)


def edge_graph(vertices: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """The edges of a mesh with their lengths, each once, for shortest paths: (V, V)."""
    pairs = edges_of(faces).pairs
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    n = len(vertices)
    # no length is zero, which a sparse matrix would leave out
    return csr_matrix((length.clip(1e-300), (pairs[:, 0], pairs[:, 1])), shape=(n, n))


def decimate(
    vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Collapse the shortest edges of a mesh (V, 3), (F, 3) until about ``count`` faces remain.

    Returns:
        The old index (W,) of each vertex, none of which moves; the new faces (G, 3); and the old
        face (G,) of each.
    """
    import igl

    _, coarse, birth, kept = igl.decimate(
        np.asfortranarray(vertices, dtype=np.float64), np.asfortranarray(faces, np.int32), count
    )
    return np.asarray(kept), np.asarray(coarse, dtype=np.int64), np.asarray(birth)


def ambient_occlusion(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The share (V,) of the outer half space that the mesh hides from each vertex.

    The rays have fixed directions, evenly spread. libigl's function draws them at random, so a
    seam that depends on it could not be reproduced.
    """
    import igl

    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit = (vertices - low) / np.linalg.norm(high - low)  # libigl's tolerances are absolute
    normals = igl.per_vertex_normals(unit, faces)
    tree = igl.AABB()
    tree.init(unit, faces)
    number = np.arange(_DIRECTIONS) + 0.5
    height, angle = 1 - 2 * number / _DIRECTIONS, np.pi * (1 + 5**0.5) * number
    radius = np.sqrt(1 - height**2)  # a Fibonacci spiral
    hits = np.zeros(len(vertices))
    for direction in np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1):
        outward = np.where(normals @ direction < 0, -1.0, 1.0)[:, None] * direction
        start = unit + 1e-4 * outward  # off the mesh
        first, _, _ = tree.intersect_ray_first(unit, faces, start, outward)
        hits += first >= 0
    return hits / _DIRECTIONS


def point_mesh_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distances (N,) from points (N, 3) to a mesh; infinite if any coordinate is not finite."""
    import igl

    if not (np.isfinite(points).all() and np.isfinite(vertices).all()):
        return np.full(len(points), np.inf)
    squared = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(vertices), faces
    )[0]
    return np.sqrt(np.maximum(squared, 0))


def triangle_distortion(
    points: np.ndarray, image: np.ndarray, faces: np.ndarray, eps: float = 0.01
) -> np.ndarray:
    """Symmetric Dirichlet energy (F,) of each triangle's affine map from points to image (V, 3).

    METHOD Eq. 2, tr(M) + tr((M + eps I)⁻¹), from the trace and determinant of M = A⁻¹B; infinite
    for degenerate triangles of points.
    """

    def forms(p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        a, b, c = (p[faces[:, k]] for k in range(3))
        u, v = b - a, c - a
        return (u * u).sum(axis=1), (u * v).sum(axis=1), (v * v).sum(axis=1)

    (e, f, g), (h, m, n) = forms(points), forms(image)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (e * g - f * f)
        trace = (g * h - 2 * f * m + e * n) * inverse
        determinant = (h * n - m * m) * inverse
        value = trace + (trace + 2 * eps) / (determinant + eps * trace + eps**2)
    return np.where(np.isfinite(value), value, np.inf)
