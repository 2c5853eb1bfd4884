"""Shaded pictures of meshes without a window or a driver.

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

from nsm.compiled import compiled
from nsm.results.rasteriser import interpolated, rasterise

Blend = Callable[[np.ndarray], np.ndarray]

_SUPERSAMPLING = 2
_LIGHT = np.array([-0.35, 0.55, 0.75]) / np.linalg.norm([-0.35, 0.55, 0.75])
_BETWEEN = (_LIGHT + [0, 0, 1]) / 1.87  # the light and the viewer: where highlights are


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
            vertices, faces, seam_pairs: as for :meth:`seen`.
            colours: as for :meth:`Seen.painted`.
        """
        return self.seen(vertices, faces, seam_pairs).painted(colours)

    def seen(
        self, vertices: np.ndarray, faces: np.ndarray, seam_pairs: np.ndarray | None = None
    ) -> Seen:
        """A mesh as it is seen, to be painted once or more.

        Args:
            vertices, faces: the mesh (V, 3), (F, 3).
            seam_pairs: (T, 2) vertices that were one before the cut, which share a normal.
        """
        xy, depth = self.pixels(vertices)
        found = rasterise(xy * _SUPERSAMPLING, depth, faces, self.size * _SUPERSAMPLING)
        return Seen(
            self.size, faces, *found, vertex_normals(vertices @ self.frame.T, faces, seam_pairs)
        )


class Seen:
    """What a view shows of a mesh, and how it is lit.

    Args:
        size: side of the picture in pixels.
        faces: (F, 3).
        pixel, face, weights: of the finer picture that pixels are the means of, as
            :func:`nsm.results.rasteriser.rasterise` gives them.
        normals: (V, 3), the third coordinate towards the viewer.
    """

    def __init__(
        self,
        size: int,
        faces: np.ndarray,
        pixel: np.ndarray,
        face: np.ndarray,
        weights: np.ndarray,
        normals: np.ndarray,
    ) -> None:
        self._size, self._pixel = size, pixel
        self._corners, self._weights = faces[face], weights
        self._lit, self._shine = np.empty(len(pixel)), np.empty(len(pixel))
        _light(self._blend(normals), _LIGHT, _BETWEEN, self._lit, self._shine)

    def painted(self, colours: Callable[[Blend], np.ndarray]) -> np.ndarray:
        """A shaded picture (size, size, 3) in [0, 1] on white.

        Args:
            colours: gives the colours (P, 3) in [0, 1] of the pixels, from a function that
                interpolates vertex values (V, k) to them, (P, k).
        """
        of_pixels = np.empty((len(self._pixel), 3))
        of_pixels[:] = colours(self._blend)  # perhaps one for all
        fine = self._size * _SUPERSAMPLING
        row = np.full(fine * fine, -1)
        row[self._pixel] = np.arange(len(self._pixel))
        picture = np.empty((self._size, self._size, 3))
        _compose(
            row.reshape(fine, fine), of_pixels, self._lit, self._shine, _SUPERSAMPLING, picture
        )
        return picture

    def _blend(self, values: np.ndarray) -> np.ndarray:
        return interpolated(values, self._corners, self._weights)


@compiled
def _light(
    normals: np.ndarray,
    light: np.ndarray,
    between: np.ndarray,
    lit: np.ndarray,
    shine: np.ndarray,
) -> None:
    """Write how brightly surfaces of these normals (P, 3), of any length and to either side, show
    their colours (P,), and the white of highlights (P,)."""
    for p in range(len(normals)):
        x, y, z = normals[p, 0], normals[p, 1], normals[p, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        if z < 0:
            length = -length
        x, y, z = x / length, y / length, z / length
        facing = x * light[0] + y * light[1] + z * light[2]
        lit[p] = 0.38 + 0.62 * min(max(facing, 0.0), 1.0)
        facing = x * between[0] + y * between[1] + z * between[2]
        shine[p] = 0.12 * min(max(facing, 0.0), 1.0) ** 24


@compiled
def _compose(
    row: np.ndarray,
    colours: np.ndarray,
    lit: np.ndarray,
    shine: np.ndarray,
    finer: int,
    picture: np.ndarray,
) -> None:
    """Write a picture (S, S, 3): each pixel is the mean of ``finer`` ones a side, which are white
    or, where ``row`` is not negative, of that row of the colours (P, 3)."""
    size = len(picture)
    for y in range(size):
        for x in range(size):
            for channel in range(3):
                total = 0.0
                for i in range(finer):
                    for j in range(finer):
                        p = row[y * finer + i, x * finer + j]
                        if p < 0:
                            total += 1
                        else:
                            shown = colours[p, channel] * lit[p] + shine[p]
                            total += min(max(shown, 0.0), 1.0)
                picture[y, x, channel] = total / finer**2


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
