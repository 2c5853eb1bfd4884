"""Colours that are told apart at a glance, for points that belong together on several shapes."""

from __future__ import annotations

import functools

import numpy as np
from trimesh.visual.color import srgb_to_linear

_STEPS = 12  # of each of red, green and blue
_LIGHTNESS = (30.0, 80.0)  # on white ground and grey shapes
_GREY = 25.0  # least chroma
# linear sRGB to XYZ, each over its white (IEC 61966-2-1, D65)
_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
) / np.array([[0.95047], [1.0], [1.08883]])


def distinct_colours(count: int) -> np.ndarray:
    """Colours (count, 3) uint8, each as far as it can be from all before it, in CIELAB.

    The first ones do not depend on ``count``.
    """
    return _chosen(max(count, 1))[:count]


@functools.cache
def _chosen(count: int) -> np.ndarray:
    side = np.linspace(0, 1, _STEPS)
    rgb = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    lab = as_lab(rgb)
    lightness, chroma = lab[:, 0], np.linalg.norm(lab[:, 1:], axis=1)
    kept = (lightness > _LIGHTNESS[0]) & (lightness < _LIGHTNESS[1]) & (chroma > _GREY)
    rgb, lab = rgb[kept], lab[kept]
    chosen = [int(np.linalg.norm(rgb - [0.85, 0.1, 0.1], axis=1).argmin())]
    apart = np.full(len(lab), np.inf)
    for _ in range(count - 1):
        apart = np.minimum(apart, np.linalg.norm(lab - lab[chosen[-1]], axis=1))
        chosen.append(int(apart.argmax()))
    return np.round(255 * rgb[chosen]).astype(np.uint8)


def as_lab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB (N, 3), D65, of colours (N, 3) of sRGB in [0, 1]."""
    ratio = srgb_to_linear(rgb) @ _XYZ.T
    delta = 6 / 29
    f = np.where(ratio > delta**3, np.cbrt(ratio), ratio / (3 * delta**2) + 4 / 29)
    x, y, z = f.T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)
