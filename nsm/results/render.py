"""A small exact rasteriser: pictures of meshes without a window or a driver.

Drawing libraries need OpenGL, which servers often lack, or take seconds to draw triangle by
triangle and sort them wrongly; a picture during training may take a fraction of a second.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

Blend = Callable[[np.ndarray], np.ndarray]

_SUPERSAMPLING = 2
_CHUNK = 4_000_000  # pixels in the boxes around the triangles of one pass
_SLACK = 1e-9  # of a barycentric coordinate: rounding leaves no pixel out
_LIGHT = np.array([-0.35, 0.55, 0.75]) / np.linalg.norm([-0.35, 0.55, 0.75])


# rotations of each axis to y, the upward axis of a view
UP_AXES = {
    sign + axis: flip @ np.roll(np.eye(3), -k, axis=0)
    for sign, flip in (("", np.eye(3)), ("-", np.diag([-1.0, -1.0, 1.0])))
    for k, axis in enumerate("yzx")
}

_up: ContextVar[str] = ContextVar("up", default="y")


@contextmanager
def upright(axis: str) -> Iterator[None]:
    """Within the block, views show an axis of :data:`UP_AXES` upwards."""
    token = _up.set(axis)
    try:
        yield
    finally:
        _up.reset(token)


def axis_of(settings: Mapping[str, Any]) -> str:
    """The axis that settings have upwards; y where they, perhaps a stranger's, name none."""
    axis = settings.get("up")
    return axis if isinstance(axis, str) and axis in UP_AXES else "y"


def frames_of(vertices: np.ndarray) -> dict[str, np.ndarray]:
    """The good view (see :func:`view_frame`) of a mesh (V, 3) by the axis that points up."""
    return {axis: view_frame(vertices @ turn.T) @ turn for axis, turn in UP_AXES.items()}


def view_frame(vertices: np.ndarray) -> np.ndarray:
    """Rows right, up and towards the viewer (3, 3) of a good view of a mesh.

    Up is y, as in most mesh files, and the view shows the longer horizontal side; of a height field
    over x and y it is from above, at a slant.
    """
    extent = np.ptp(vertices, axis=0)
    if extent[2] < 0.25 * extent[:2].min():
        tilt = np.radians(50)
        sine, cosine = float(np.sin(tilt)), float(np.cos(tilt))
        return np.array([[1.0, 0.0, 0.0], [0.0, sine, cosine], [0.0, -cosine, sine]])
    vertical = np.array([0.0, 1.0, 0.0])
    front = np.array([0.0, 0.0, 1.0]) if extent[2] <= extent[0] else np.array([1.0, 0.0, 0.0])
    towards = front + 0.5 * np.cross(vertical, front) + 0.3 * vertical
    towards /= np.linalg.norm(towards)
    right = np.cross(vertical, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def rasterise(
    xy: np.ndarray, depth: np.ndarray, faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest face at each pixel of a square picture.

    Args:
        xy: (V, 2) vertices in pixels, y downwards.
        depth: (V,), larger is nearer.
        faces: (F, 3).
        size: side of the picture in pixels.

    Returns:
        pixels (P,) flat indices of those covered, their face (P,) and its barycentric
        coordinates (P, 3).
    """
    pixel, face, weights = covering(xy, faces, size)
    near = np.einsum("pk,pk->p", weights, depth[faces[face]])
    nearest = np.full(size * size, -np.inf)
    np.fmax.at(nearest, pixel, near)
    of_pixel = np.full(size * size, -1)
    seen = np.flatnonzero(near == nearest[pixel])
    of_pixel[pixel[seen]] = seen  # of several at one depth the last
    chosen = of_pixel[of_pixel >= 0]
    return pixel[chosen], face[chosen], weights[chosen]


def covering(
    xy: np.ndarray, faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every face at each pixel of a square picture: as :func:`rasterise`, with a row for each pair
    of a pixel and a face that contains its centre."""
    corners = xy[faces]
    # skip triangles that are not finite or far larger than the picture
    visible = np.isfinite(corners).all(axis=(1, 2)) & (np.abs(corners) < 4 * size).all(axis=(1, 2))
    kept = np.flatnonzero(visible)
    low = np.clip(np.floor(corners[kept].min(axis=1)), 0, size).astype(np.int64)
    high = np.clip(np.ceil(corners[kept].max(axis=1)), 0, size).astype(np.int64)
    part = np.cumsum((high - low).prod(axis=1)) // _CHUNK
    starts = np.flatnonzero(np.diff(part, prepend=-1))
    hits = []
    for some in np.split(np.arange(len(kept)), starts[1:]):
        face = kept[some]
        hits.append(_covered(corners[face], low[some], high[some], size, face))
    pixel, face, weights = (np.concatenate(parts) for parts in zip(*hits, strict=True))
    return pixel, face, weights


def _covered(
    corners: np.ndarray, low: np.ndarray, high: np.ndarray, size: int, face: np.ndarray
) -> tuple[np.ndarray, ...]:
    """What triangles (F, 3, 2) cover of the pixels from ``low`` to before ``high`` (F, 2).

    Along a row each barycentric coordinate is slope · x + offset, so that only the pixels between
    the roots are looked at.
    """
    a, b, c = (corners[:, k] for k in range(3))
    area = _cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        # the gradients of w1 and w2; not finite for triangles seen edge-on, which cover nothing
        slope1, slope2 = (
            np.stack([e[:, 1], -e[:, 0]], axis=1) / area[:, None] for e in (c - a, a - b)
        )
        slopes = np.stack([-slope1 - slope2, slope1, slope2])
    covers = np.isfinite(slopes).all(axis=(0, 2))
    row, of = _ranges(low[:, 1], np.where(covers, high[:, 1], low[:, 1]))
    slopes = slopes[:, of]
    first, last = low[of, 0].astype(float), high[of, 0] - 1.0
    y = row + 0.5 - a[of, 1]
    for k in range(3):
        slope, offset = slopes[k, :, 0], (k == 0) + slopes[k, :, 1] * y
        with np.errstate(divide="ignore", invalid="ignore"):
            root = a[of, 0] - (offset + _SLACK) / slope - 0.5
        np.copyto(first, np.ceil(root), where=(slope > 0) & (root > first))
        np.copyto(last, np.floor(root), where=(slope < 0) & (root < last))
    column, line = _ranges(first.astype(np.int64), last.astype(np.int64) + 1)
    x, y, of = column + 0.5 - a[of[line], 0], y[line], of[line]
    w1, w2 = (slope[of, 0] * x + slope[of, 1] * y for slope in (slope1, slope2))
    weights = np.stack([1 - w1 - w2, w1, w2], axis=1)
    inside = (weights >= 0).all(axis=1)
    return (row[line] * size + column)[inside], face[of[inside]], weights[inside]


def _ranges(first: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The whole numbers of each range [first, end), in turn, and which range each is of."""
    count = np.maximum(end - first, 0)
    of = np.repeat(np.arange(len(count)), count)
    return np.arange(len(of)) - (np.cumsum(count) - count - first)[of], of


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


class View:
    """A fixed camera on a reference mesh, so that pictures can be compared side by side.

    Args:
        reference: vertices (V, 3) that fill the picture.
        size: side of the picture in pixels.
        frame: rows right, up, towards the viewer (3, 3); by default :func:`view_frame`, with the
            axis upwards that :func:`upright` names.
    """

    def __init__(self, reference: np.ndarray, size: int, frame: np.ndarray | None = None) -> None:
        self.frame = frames_of(reference)[_up.get()] if frame is None else frame
        turned = reference @ self.frame.T
        self.center = 0.5 * (turned.min(axis=0) + turned.max(axis=0))
        self.half = 0.53 * float(np.ptp(turned[:, :2], axis=0).max())
        self.size = size

    def pixels(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (V, 3) are in a picture, (V, 2) to the right and downwards, and their depth
        (V,), larger is nearer."""
        turned = vertices @ self.frame.T
        flat = (turned[:, :2] - self.center[:2]) / self.half
        return np.stack([flat[:, 0] + 1, 1 - flat[:, 1]], axis=1) * 0.5 * self.size, turned[:, 2]

    def draw(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        colours: Callable[[Blend], np.ndarray],
        seam_pairs: np.ndarray | None = None,
    ) -> np.ndarray:
        """A shaded picture (size, size, 3) in [0, 1] on white.

        Args:
            vertices, faces: the mesh (V, 3), (F, 3).
            colours: gives the colours (P, 3) in [0, 1] of the pixels, from a function that
                interpolates vertex values (V, k) to them, (P, k).
            seam_pairs: (T, 2) vertices that were one before the cut, which share a normal.
        """
        fine = self.size * _SUPERSAMPLING
        xy, depth = self.pixels(vertices)
        pixel, face, weights = rasterise(xy * _SUPERSAMPLING, depth, faces, fine)
        corners = faces[face]

        def blend(values: np.ndarray) -> np.ndarray:
            return np.einsum("pk,pkd->pd", weights, values[corners])

        base = colours(blend)
        normal = blend(vertex_normals(vertices @ self.frame.T, faces, seam_pairs))
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
        facing = np.where(normal[:, 2:] < 0, -normal, normal)
        lit = 0.38 + 0.62 * np.clip(facing @ _LIGHT, 0, 1)
        shine = 0.12 * np.clip(facing @ (_LIGHT + [0, 0, 1]) / 1.87, 0, 1) ** 24
        picture = np.ones((fine * fine, 3))
        picture[pixel] = np.clip(base * lit[:, None] + shine[:, None], 0, 1)
        parts = picture.reshape(self.size, _SUPERSAMPLING, self.size, _SUPERSAMPLING, 3)
        finer = np.ndindex(_SUPERSAMPLING, _SUPERSAMPLING)
        return np.mean([parts[:, i, :, j] for i, j in finer], axis=0)


def vertex_normals(
    vertices: np.ndarray, faces: np.ndarray, seam_pairs: np.ndarray | None = None
) -> np.ndarray:
    """Unit normals (V, 3) of a mesh (V, 3), (F, 3), weighted by area; zero where there is none.

    Vertices that were one before the mesh was cut, ``seam_pairs`` (T, 2), have one normal.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    point = np.arange(len(vertices))
    if seam_pairs is not None:
        links = coo_matrix(
            (np.ones(len(seam_pairs)), tuple(seam_pairs.T)), shape=(len(point), len(point))
        )
        point = connected_components(links, directed=False)[1]
    total = np.zeros_like(vertices)
    np.add.at(total, point[faces].ravel(), np.repeat(np.cross(b - a, c - a), 3, axis=0))
    total = total[point]
    return total / np.maximum(np.linalg.norm(total, axis=1), 1e-30)[:, None]
