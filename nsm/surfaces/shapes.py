"""Meshes of simple shapes: planes, spheres, tori and others.

Every function returns vertices (V, 3) float64 and triangles (F, 3) int64, counter-clockwise seen
from outside, or from above (+z) for open height fields.
"""

from __future__ import annotations

import numpy as np

from nsm.surfaces import topology

Mesh = tuple[np.ndarray, np.ndarray]


def grid_faces(
    rows: int, columns: int, *, wrap_rows: bool = False, wrap_columns: bool = False
) -> np.ndarray:
    """Triangles (F, 3) of a grid of rows x columns vertices, numbered row by row.

    They are counter-clockwise if columns run along x and rows along y. A wrapped direction connects
    its last vertices to its first. Diagonals alternate: no direction is preferred and, with odd
    vertex counts, no triangle at a corner has two boundary edges.
    """
    cells = np.meshgrid(
        np.arange(rows if wrap_rows else rows - 1),
        np.arange(columns if wrap_columns else columns - 1),
        indexing="ij",
    )
    i, j = (index.ravel() for index in cells)
    below, right = (i + 1) % rows, (j + 1) % columns
    a, b = i * columns + j, i * columns + right
    c, d = below * columns + right, below * columns + j
    even = (i + j) % 2 == 0
    first = np.where(even[:, None], np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    second = np.where(even[:, None], np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    return np.stack([first, second], axis=1).reshape(-1, 3).astype(np.int64)


def plane(n: int = 45) -> Mesh:
    """The square [-1,1]^2 at z = 0, n x n vertices."""
    t = np.linspace(-1.0, 1.0, n)
    y, x = np.meshgrid(t, t, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1), grid_faces(n, n)


def saddle(n: int = 45) -> Mesh:
    """z = (x^2 - y^2) / 2 over the square [-1,1]^2, n x n vertices."""
    vertices, faces = plane(n)
    vertices[:, 2] = 0.5 * (vertices[:, 0] ** 2 - vertices[:, 1] ** 2)
    return vertices, faces


def hemisphere(rings: int = 24) -> Mesh:
    """The upper half of the unit sphere, open at the equator; 3 rings (rings + 1) + 1 vertices."""
    radius, angle, faces = _rings(rings)
    polar = 0.5 * np.pi * radius
    return (
        np.stack(
            [np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)], axis=1
        ),
        faces,
    )


def cone(rings: int = 24, height: float = 1.5) -> Mesh:
    """A cone of base radius 1 with its tip at z = height, open at the base."""
    radius, angle, faces = _rings(rings)
    return (
        np.stack([radius * np.cos(angle), radius * np.sin(angle), height * (1 - radius)], axis=1),
        faces,
    )


def ring_mesh(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of the unit disc in concentric rings: points (V, 2), faces (F, 3)."""
    radius, angle, faces = _rings(rings)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), faces


def grid_mesh(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of the square [-1, 1]² with side × side points: points (V, 2), faces (F, 3)."""
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    return np.stack([x.ravel(), y.ravel()], axis=1), grid_faces(side, side)


def _rings(rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radius (V,) in [0,1], angle (V,) and faces of a disc of rings; ring k has 6k vertices."""
    radius, angle = [np.zeros(1)], [np.zeros(1)]
    faces: list[tuple[int, int, int]] = []
    for k in range(1, rings + 1):
        radius.append(np.full(6 * k, k / rings))
        angle.append(2 * np.pi * np.arange(6 * k) / (6 * k))
        outer, inner = 1 + 3 * k * (k - 1), 1 + 3 * (k - 1) * (k - 2)
        for sector in range(6):
            out = [outer + (sector * k + i) % (6 * k) for i in range(k + 1)]
            if k == 1:
                faces.append((0, out[0], out[1]))
                continue
            inn = [inner + (sector * (k - 1) + i) % (6 * (k - 1)) for i in range(k)]
            faces += [(inn[i], out[i], out[i + 1]) for i in range(k)]
            faces += [(inn[i], out[i + 1], inn[i + 1]) for i in range(k - 1)]
    return np.concatenate(radius), np.concatenate(angle), np.array(faces, dtype=np.int64)


def cylinder(around: int = 64, along: int = 31) -> Mesh:
    """A tube of radius 1 from z = -1 to z = 1, open at both ends."""
    z, angle = np.meshgrid(
        np.linspace(-1.0, 1.0, along), 2 * np.pi * np.arange(around) / around, indexing="ij"
    )
    vertices = np.stack([np.cos(angle), np.sin(angle), z], axis=-1).reshape(-1, 3)
    return vertices, grid_faces(along, around, wrap_columns=True)


def torus(around: int = 64, across: int = 32, tube: float = 0.4) -> Mesh:
    """A torus about the z axis: a tube of the given radius around the unit circle."""
    small, large = np.meshgrid(
        2 * np.pi * np.arange(across) / across,
        2 * np.pi * np.arange(around) / around,
        indexing="ij",
    )
    reach = 1.0 + tube * np.cos(small)
    vertices = np.stack(
        [reach * np.cos(large), reach * np.sin(large), tube * np.sin(small)], axis=-1
    ).reshape(-1, 3)
    return vertices, grid_faces(across, around, wrap_rows=True, wrap_columns=True)


def sphere(subdivisions: int = 4) -> Mesh:
    """The unit sphere as a subdivided icosahedron; 10 * 4^subdivisions + 2 vertices."""
    from trimesh.creation import icosahedron

    base = icosahedron()
    # with the vertices (±1, ±g, 0) and so on, where g is the golden ratio
    vertices = np.array(base.vertices / base.vertices[1, 0])
    faces = np.array(base.faces, dtype=np.int64)
    for _ in range(subdivisions):
        edges = topology.edges_of(faces)
        ab, bc, ca = (len(vertices) + edges.of_corner).T
        a, b, c = faces.T
        vertices = np.concatenate([vertices, vertices[edges.pairs].mean(axis=1)])
        faces = np.stack(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))],
            axis=1,
        ).reshape(-1, 3)
        # projecting after each subdivision makes the triangles more even
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces
