"""Shapes as GLB, for the browser."""

from __future__ import annotations

import numpy as np

from nsm.results.glb import as_glb
from nsm.results.textures import checkerboard
from nsm.results.view.scene import Paint, Shape


def painted_glb(shape: Shape, vertices: np.ndarray, paint: Paint) -> bytes:
    """A shape with its vertices at (V, 3), painted, and with smooth normals."""
    faces, normals, board = shape.faces, shape.normals(vertices), paint.checkerboard
    if board is not None and board.ndim == 3:  # a vertex for each corner
        vertices, normals = vertices[faces].reshape(-1, 3), normals[faces].reshape(-1, 3)
        board, faces = board.reshape(-1, 2), np.arange(len(vertices)).reshape(-1, 3)
    return as_glb(
        vertices,
        faces,
        uv=None if board is None else 0.5 * (board + 1),
        image=None if board is None else checkerboard(),
        colours=paint.colours,
        normals=normals,
    )
