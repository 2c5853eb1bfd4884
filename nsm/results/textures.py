"""Checkerboard textures, which show distortion."""

from __future__ import annotations

import numpy as np
from PIL import Image

_COLOURS = np.array([[245, 243, 238], [52, 92, 140]], dtype=np.uint8)


def checkerboard(size: int = 1024, squares: int = 32) -> Image.Image:
    """A square checkerboard picture, ``size`` pixels and ``squares`` squares a side."""
    cell = np.arange(size) * squares // size
    return Image.fromarray(_COLOURS[(cell[:, None] + cell[None, :]) % 2])


def checkerboard_at(uv: np.ndarray, squares: int = 32) -> np.ndarray:
    """The checkerboard's colours (N, 3) in [0, 1] at points (N, 2) of [-1, 1]²."""
    cell = np.floor(0.5 * (uv + 1) * squares).astype(np.int64)
    return _COLOURS[cell.sum(axis=1) % 2] / 255.0
