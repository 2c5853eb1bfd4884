"""Checkerboard textures, which show distortion."""

from __future__ import annotations

import numpy as np
from PIL import Image

GREY = np.array([0.80, 0.82, 0.85])  # where there is nothing to show
_COLOURS = np.array([[245, 243, 238], [52, 92, 140]], dtype=np.uint8)
_SHOWN = np.vstack([_COLOURS / 255, GREY])


def checkerboard(size: int = 1024, squares: int = 32) -> Image.Image:
    """A square checkerboard picture, ``size`` pixels and ``squares`` squares a side."""
    cell = np.arange(size) * squares // size
    return Image.fromarray(_COLOURS[(cell[:, None] + cell[None, :]) % 2])


def checkerboard_at(uv: np.ndarray, squares: int = 32) -> np.ndarray:
    """The checkerboard's colours (N, 3) in [0, 1] at points (N, 2) of [-1, 1]²; grey at NaN."""
    u, v = uv.T
    there = np.isfinite(u) & np.isfinite(v)
    cells = (np.floor(0.5 * (np.where(there, x, 0.0) + 1) * squares) for x in (u, v))
    row, column = (cell.astype(np.int64) for cell in cells)
    return _SHOWN[np.where(there, (row + column) & 1, 2)]
