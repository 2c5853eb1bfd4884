"""Shapes as GLB, for the browser."""

from __future__ import annotations

import numpy as np

from nsm.results.glb import as_glb
from nsm.results.textures import checkerboard
from nsm.results.view.scene import Paint, Shape


def painted_glb(shape: Shape, vertices: np.ndarray, paint: Paint) -> bytes:
    """A shape with its vertices at (V, 3), painted, and with smooth normals."""
    board = paint.checkerboard
    return as_glb(
        vertices,
        shape.faces,
        uv=None if board is None else 0.5 * (board + 1),
        image=None if board is None else checkerboard(),
        colours=paint.colours,
        normals=shape.normals(vertices),
    )
