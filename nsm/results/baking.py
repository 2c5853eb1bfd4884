"""Textures baked texel by texel: which point of a mesh each texel shows, and padding of charts.

Texture coordinates are those of :mod:`nsm.surfaces.textures`; a texel's colour holds at its centre.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from nsm.results.rasteriser import covering, rasterise
from nsm.surfaces.location import locate
from nsm.surfaces.textures import Texture
from nsm.surfaces.topology import face_areas

# A lookup between texel centres reaches texels up to √2 from the point.
_REACH = 2
_OUTSIDE = 1e-6  # of the unit square, from rounding
# An atlas serves if at most this share of its texels is claimed by two faces, and at most this
# share of the surface has no texels at all.
_DOUBLE = 1e-3
_INSIDE = 1e-6  # barycentric coordinates of texels within a face, not on a side of it

Colours = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Texels(NamedTuple):
    """Texels of a square image, and the points of a mesh that they show.

    Attributes:
        texel: (P,) flat indices, the first row at the top.
        face: (P,) a face of each.
        weights: (P, 3) its barycentric coordinates there.
    """

    texel: np.ndarray
    face: np.ndarray
    weights: np.ndarray


def baked(uv: np.ndarray, colours: Colours, size: int) -> np.ndarray:
    """The image of a mesh with given colours at the points of its faces.

    A texel that no face contains, but that lookups near the border of a chart reach, takes the
    colour of the nearest point of a chart. The texels beyond take that of the nearest texel, so
    that smaller versions of the image have no seams either.

    Args:
        uv: (F, 3, 2) texture coordinates at the corners of the faces, in [0, 1].
        colours: gives colours (P, C) in [0, 255] at points of faces, from these faces (P,) and
            barycentric coordinates (P, 3).
        size: texels a side.

    Returns:
        (size, size, C) uint8.
    """
    inside, rim = texels(uv, size), rim_texels(uv, size)
    shown = Texels(*(np.concatenate(both) for both in zip(inside, rim, strict=True)))
    values = colours(shown.face, shown.weights)
    image = np.zeros((size * size, values.shape[1]), dtype=np.uint8)
    known = np.zeros(size * size, dtype=bool)
    image[shown.texel] = np.rint(np.clip(values, 0, 255)).astype(np.uint8)
    known[shown.texel] = True
    square = (size, size)
    return _spread(image.reshape(*square, -1), known.reshape(square))


def texels(uv: np.ndarray, size: int) -> Texels:
    """The texels whose centres lie in the triangles uv (F, 3, 2)."""
    xy, faces = _in_texels(uv, size, size)
    return Texels(*rasterise(xy, np.zeros(len(xy)), faces, size))


def rim_texels(uv: np.ndarray, size: int) -> Texels:
    """The texels around the triangles uv (F, 3, 2) that lookups within these reach, with the
    nearest points of the triangles."""
    xy, faces = _in_texels(uv, size, size)
    inside = np.zeros(size * size, dtype=bool)
    inside[covering(xy, faces, size)[0]] = True
    near: np.ndarray = _touched(xy, size) | inside.reshape(size, size)
    near = binary_dilation(near, np.ones((3, 3)), iterations=_REACH)
    texel = np.flatnonzero(near.reshape(-1) & ~inside)
    centre = np.stack([texel % size, texel // size], axis=1) + 0.5
    if len(texel) == 0:
        return Texels(texel, texel, np.zeros((0, 3)))
    return Texels(texel, *locate(centre, xy, faces))


def _in_texels(uv: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3 F, 2) of triangles uv (F, 3, 2), x to the right and y downwards, and faces."""
    corners = uv.reshape(-1, 2)
    xy = np.stack([corners[:, 0] * width, (1 - corners[:, 1]) * height], axis=1)
    return xy, np.arange(len(xy)).reshape(-1, 3)


def _touched(xy: np.ndarray, size: int) -> np.ndarray:
    """Mask (size, size) of texels at the sides of triangles, whose corners (3 F, 2) these are."""
    start, end = xy, np.roll(xy.reshape(-1, 3, 2), -1, axis=1).reshape(-1, 2)
    count = np.ceil(2 * np.linalg.norm(end - start, axis=1)).astype(np.int64) + 1
    side = np.repeat(np.arange(len(start)), count)
    step = np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count)
    along = (step / np.maximum(count - 1, 1)[side])[:, None]
    points = (1 - along) * start[side] + along * end[side]
    column, row = np.clip(points, 0, size - 1).astype(np.int64).T
    mask = np.zeros((size, size), dtype=bool)
    mask[row, column] = True
    return mask


def _spread(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """An image (H, W, C) whose other texels take the colour of the nearest known one (H, W)."""
    if known.all() or not known.any():
        return image
    row, column = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return image[row, column]


def padded(texture: Texture) -> Texture:
    """A texture whose texels outside its charts take the colour of the nearest one inside.

    Points at the border of a chart are then not mixed with the background. Charts that contain no
    texel's centre, such as faces that point at one colour of a palette, keep the texels around
    them. Images that repeat have no background and stay as they are.
    """
    images = list(texture.images)
    for k, image in enumerate(images):
        uv = texture.uv[texture.image == k]
        if image.shape[0] * image.shape[1] > 1 and len(uv) and _within(uv):
            images[k] = _spread(image, _painted(uv, image.shape[0], image.shape[1]))
    return Texture(texture.uv, tuple(images), texture.image)


def _painted(uv: np.ndarray, height: int, width: int) -> np.ndarray:
    """Mask (H, W) of texels with centres in triangles uv (F, 3, 2), and of those at the sides of
    charts without any."""
    size = max(height, width)
    xy, faces = _in_texels(uv, width, height)
    texel, face, _ = covering(xy, faces, size)
    mask = np.zeros((size, size), dtype=bool)
    mask.flat[texel] = True
    chart = charts(uv)
    thin = ~np.isin(chart, chart[face])
    if thin.any():
        around = _touched(xy[faces[thin]].reshape(-1, 2), size)
        mask |= binary_dilation(around, np.ones((3, 3)), iterations=_REACH)
    return mask[:height, :width]


def charts(uv: np.ndarray) -> np.ndarray:
    """The number (F,) of each face's chart: faces with texture coordinates (F, 3, 2) in common."""
    _, corner = np.unique(uv.reshape(-1, 2), axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3)
    first = np.repeat(corner[:, :1], 2, axis=1).reshape(-1)
    other, n = corner[:, 1:].reshape(-1), int(corner.max()) + 1
    links = coo_matrix((np.ones(len(first)), (first, other)), shape=(n, n))
    return connected_components(links, directed=False)[1][corner[:, 0]]


def _within(uv: np.ndarray) -> bool:
    return bool(uv.min() >= -_OUTSIDE and uv.max() <= 1 + _OUTSIDE)


def atlas_fault(uv: np.ndarray, corners: np.ndarray, size: int) -> str | None:
    """Why colours cannot be baked into texture coordinates, or None.

    Args:
        uv: (F, 3, 2) at the corners of faces.
        corners: (F, 3, 3) the corners in space.
        size: of the image.
    """
    if not _within(uv):
        return "texture coordinates outside [0, 1]"
    texel, face, weights = covering(*_in_texels(uv, size, size), size)
    inner = texel[weights.min(axis=1) > _INSIDE]
    if len(inner) - len(np.unique(inner)) > _DOUBLE * max(len(inner), 1):
        return "overlapping texture coordinates"
    faces = np.arange(3 * len(uv)).reshape(-1, 3)
    area = face_areas(corners.reshape(-1, 3), faces)
    collapsed = face_areas(np.pad(uv.reshape(-1, 2), ((0, 0), (0, 1))), faces) <= 0
    if area[collapsed].sum() > _DOUBLE * area.sum():
        return "faces without area in the image"
    return None
