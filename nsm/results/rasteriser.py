"""Which triangles lie at which pixels of a picture, as compiled loops over triangles and rows."""

from __future__ import annotations

from typing import Literal

import numpy as np

from nsm.compiled import compiled

# of arrays, as loops are compiled for them: numba compiles anew for any other
_LAYOUT: list[Literal["C", "A", "W"]] = ["C", "A", "W"]
_SLACK = 1e-9  # of a barycentric coordinate: rounding leaves no pixel out


def rasterise(
    xy: np.ndarray, depth: np.ndarray, faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest face at each pixel of a square picture; of several at one depth the last.

    Args:
        xy: (V, 2) vertices in pixels, y downwards.
        depth: (V,), larger is nearer.
        faces: (F, 3).
        size: side of the picture in pixels.

    Returns:
        pixels (P,) flat indices of those covered, ascending, their face (P,) and its barycentric
        coordinates (P, 3).
    """
    xy, faces = _plain(xy, faces)
    face_at = np.full(size * size, -1)
    nearest = np.full(size * size, -np.inf)
    _draw(xy, np.require(depth, np.float64, _LAYOUT), faces, size, nearest, face_at)
    pixel = np.flatnonzero(face_at >= 0)
    face = face_at[pixel]
    weights = np.empty((len(pixel), 3))
    _weigh(xy, faces, size, pixel, face, weights)
    return pixel, face, weights


def covering(
    xy: np.ndarray, faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every face at each pixel of a square picture: as :func:`rasterise`, with a row for each pair
    of a pixel and a face that contains its centre, by face and then by pixel."""
    xy, faces = _plain(xy, faces)
    count = _cover(xy, faces, size, np.empty(0, np.int64), np.empty(0, np.int64))
    pixel, face = np.empty(count, np.int64), np.empty(count, np.int64)
    _cover(xy, faces, size, pixel, face)
    weights = np.empty((count, 3))
    _weigh(xy, faces, size, pixel, face, weights)
    return pixel, face, weights


def interpolated(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Vertex values (V, k) at points (P, k): of each its face's vertices (P, 3) and barycentric
    coordinates (P, 3)."""
    out = np.empty((len(weights), values.shape[1]))
    values = np.require(values, np.float64, _LAYOUT)
    _interpolate(values, np.require(corners, np.int64, _LAYOUT), weights, out)
    return out


def _plain(xy: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces as the loops take them."""
    return np.require(xy, np.float64, _LAYOUT), np.require(faces, np.int64, _LAYOUT)


@compiled
def _plane(xy: np.ndarray, corners: np.ndarray, size: int, plane: np.ndarray) -> bool:
    """Write the barycentric coordinates of a triangle as functions of the place: ``plane`` (4, 2)
    is its first corner and their three gradients.

    False for triangles that cover nothing: those seen edge-on, those that are not finite, and, so
    that none takes long, those far larger than the picture.
    """
    for axis in range(2):
        a, b, c = xy[corners[0], axis], xy[corners[1], axis], xy[corners[2], axis]
        # not true of NaN either
        if not (abs(a) < 4 * size and abs(b) < 4 * size and abs(c) < 4 * size):
            return False
        plane[0, axis], plane[2, axis], plane[3, axis] = a, c - a, a - b
    right, down = plane[2, 0], plane[2, 1]
    left, up = plane[3, 0], plane[3, 1]
    area = up * right - left * down
    plane[2, 0], plane[2, 1] = down / area, -right / area
    plane[3, 0], plane[3, 1] = up / area, -left / area
    # not finite where one of the others is not
    plane[1, 0], plane[1, 1] = -plane[2, 0] - plane[3, 0], -plane[2, 1] - plane[3, 1]
    return bool(np.isfinite(plane[1, 0]) and np.isfinite(plane[1, 1]))


@compiled
def _box(xy: np.ndarray, corners: np.ndarray, size: int, axis: int) -> tuple[int, int]:
    """The pixels along an axis that a triangle may cover: the first, and the one after the last."""
    a, b, c = xy[corners[0], axis], xy[corners[1], axis], xy[corners[2], axis]
    low, high = np.floor(min(a, b, c)), np.ceil(max(a, b, c))
    return int(min(max(low, 0), size)), int(min(max(high, 0), size))


@compiled
def _span(plane: np.ndarray, row: int, first: float, last: float) -> tuple[int, int]:
    """The pixels of a row, from ``first`` to ``last``, between the roots of the barycentric
    coordinates, each of which is slope · x + offset: the first, and the one after the last."""
    y = row + 0.5 - plane[0, 1]
    for k in range(3):
        slope, offset = plane[1 + k, 0], plane[1 + k, 1] * y
        if k == 0:
            offset += 1
        root = plane[0, 0] - (offset + _SLACK) / slope - 0.5
        if slope > 0:
            first = max(first, np.ceil(root))
        elif slope < 0:
            last = min(last, np.floor(root))
    return (int(first), int(last) + 1) if first <= last else (0, 0)


@compiled
def _coordinates(plane: np.ndarray, column: int, row: int) -> tuple[float, float, float]:
    """Barycentric coordinates of a pixel's centre."""
    x, y = column + 0.5 - plane[0, 0], row + 0.5 - plane[0, 1]
    second = plane[2, 0] * x + plane[2, 1] * y
    third = plane[3, 0] * x + plane[3, 1] * y
    return 1 - second - third, second, third


@compiled
def _cover(
    xy: np.ndarray, faces: np.ndarray, size: int, pixel: np.ndarray, face: np.ndarray
) -> int:
    """Write each pixel (P,) that a face contains, and this face (P,), where there is room for them;
    how many there are."""
    plane, count = np.empty((4, 2)), 0
    for f in range(len(faces)):
        if not _plane(xy, faces[f], size, plane):
            continue
        left, right = _box(xy, faces[f], size, 0)
        top, bottom = _box(xy, faces[f], size, 1)
        for row in range(top, bottom):
            first, end = _span(plane, row, left, right - 1)
            for column in range(first, end):
                u, v, w = _coordinates(plane, column, row)
                if u >= 0 and v >= 0 and w >= 0:
                    if count < len(pixel):
                        pixel[count], face[count] = row * size + column, f
                    count += 1
    return count


@compiled
def _draw(
    xy: np.ndarray,
    depth: np.ndarray,
    faces: np.ndarray,
    size: int,
    nearest: np.ndarray,
    face_at: np.ndarray,
) -> None:
    """Write the face that is nearest at each pixel (S²,), and its depth (S²,) there."""
    plane = np.empty((4, 2))
    for f in range(len(faces)):
        if not _plane(xy, faces[f], size, plane):
            continue
        a, b, c = depth[faces[f, 0]], depth[faces[f, 1]], depth[faces[f, 2]]
        left, right = _box(xy, faces[f], size, 0)
        top, bottom = _box(xy, faces[f], size, 1)
        for row in range(top, bottom):
            first, end = _span(plane, row, left, right - 1)
            for column in range(first, end):
                u, v, w = _coordinates(plane, column, row)
                if u >= 0 and v >= 0 and w >= 0:
                    near, at = u * a + w * c + v * b, row * size + column
                    if near >= nearest[at]:
                        nearest[at], face_at[at] = near, f


@compiled
def _weigh(
    xy: np.ndarray,
    faces: np.ndarray,
    size: int,
    pixel: np.ndarray,
    face: np.ndarray,
    weights: np.ndarray,
) -> None:
    """Write the barycentric coordinates (P, 3) of pixels (P,) in faces (P,)."""
    plane, of = np.empty((4, 2)), -1
    for p in range(len(pixel)):
        if face[p] != of:
            of = face[p]
            _plane(xy, faces[of], size, plane)
        row = pixel[p] // size
        u, v, w = _coordinates(plane, pixel[p] - row * size, row)
        weights[p, 0], weights[p, 1], weights[p, 2] = u, v, w


@compiled
def _interpolate(
    values: np.ndarray, corners: np.ndarray, weights: np.ndarray, out: np.ndarray
) -> None:
    """Write the values (V, k) at points of faces (P, 3) into ``out`` (P, k)."""
    for p in range(len(out)):
        a, b, c = corners[p, 0], corners[p, 1], corners[p, 2]
        u, v, w = weights[p, 0], weights[p, 1], weights[p, 2]
        for k in range(out.shape[1]):
            out[p, k] = u * values[a, k] + v * values[b, k] + w * values[c, k]
