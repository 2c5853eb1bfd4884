"""Textures of mesh files: coordinates at the corners of the faces, and base-colour images.

Texture coordinates have (0, 0) at the lower left corner of the image and (1, 1) at the upper right
one, and repeat outside, as in OBJ files. Those of glTF, whose v goes down, are turned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nsm.surfaces import materials
from nsm.surfaces.loading import (
    LARGEST_FILE,
    check_file,
    error_in,
    fans,
    parsing,
    ply_polygons,
    read_ply,
    read_scene,
)
from nsm.surfaces.materials import Paint
from nsm.surfaces.obj import read_obj

_LARGEST_UV = 1e6  # what is beyond is damaged


@dataclass(frozen=True, eq=False)
class Texture:
    """Colours at the points of a mesh file's faces.

    Attributes:
        uv: (F, 3, 2) texture coordinates at the corners of the faces, in the order of
            :func:`nsm.surfaces.loading.load_mesh`.
        images: arrays (H, W, 3) or (H, W, 4) uint8, sRGB as in the files; all have as many
            channels.
        image: (F,) the image of each face.
    """

    uv: np.ndarray = field(repr=False)
    images: tuple[np.ndarray, ...] = field(repr=False)
    image: np.ndarray = field(repr=False)

    def colours(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Colours (N, 3) or (N, 4) in [0, 255] at points of faces, interpolated bilinearly.

        Args:
            face: (N,) the face of each point.
            weights: (N, 3) its barycentric coordinates there.
        """
        uv = np.einsum("nk,nkd->nd", weights, self.uv[face])
        result = np.zeros((len(face), self.images[0].shape[2]))
        for k in np.unique(self.image[face]):
            chosen = self.image[face] == k
            result[chosen] = bilinear(self.images[k], uv[chosen])
        return result


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours (N, C) of an image (H, W, C) at texture coordinates (N, 2); it repeats outside.

    Each texel's colour holds at its centre.
    """
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    column, row = np.floor(x), np.floor(y)
    s, t = (x - column)[:, None], (y - row)[:, None]
    left, top = column.astype(np.int64) % width, row.astype(np.int64) % height
    right, bottom = (left + 1) % width, (top + 1) % height
    upper = (1 - s) * image[top, left] + s * image[top, right]
    lower = (1 - s) * image[bottom, left] + s * image[bottom, right]
    return (1 - t) * upper + t * lower


def read_uv(path: str | Path) -> np.ndarray | None:
    """The texture coordinates (F, 3, 2) at the corners of a mesh file's faces.

    Returns:
        None if a corner has none. Faces are triangles in the order of
        :func:`nsm.surfaces.loading.load_mesh`.

    Raises:
        NsmError: ``unreadable_file``: a damaged file. The key is the path.
    """
    file = Path(path)
    if file.suffix.lower() not in _READERS:
        return None
    uv, _, _ = _read(file)
    return None if np.isnan(uv).any() else uv


def read_texture(path: str | Path, image: str | Path | None = None) -> Texture:
    """The texture of a mesh file.

    A material without an image is an image of one texel of its colour.

    Args:
        path: an OBJ, PLY, GLTF or GLB file.
        image: an image file, in place of the file's own materials.

    Raises:
        NsmError: ``missing_uv``: a face with an image has no texture coordinates;
            ``missing_texture``: no material of the file has an image; ``missing_file``,
            ``unreadable_file``, ``not_a_file`` or ``file_too_large`` of the mesh or an image. The
            key is the path of the file that is at fault.
    """
    file = Path(path)
    uv, number, paints = _read(file)
    if image is not None:
        paints, number = [lambda: materials.read_image(Path(image))], np.zeros(len(uv), np.int64)
    used, number = np.unique(number, return_inverse=True)
    found = [paints[k]() for k in used.tolist()]
    if all(one.size <= 4 for one in found) and image is None:
        reason = "its materials have no image; give one with texture=FILE"
        raise error_in(file, "missing_texture", reason)
    bare = np.asarray(np.isnan(uv).any(axis=(1, 2)))
    # a face in one colour needs no coordinates
    painted = np.array([one.size > 4 for one in found])[number.reshape(-1)]
    faulty = np.flatnonzero(bare & painted)
    if len(faulty):
        where = "no face has" if np.all(bare) else f"face {faulty[0]} has no"
        reason = f"{where} texture coordinates; unwrap the mesh in an editor and export it with UV"
        raise error_in(file, "missing_uv", reason)
    uv = np.where(bare[:, None, None], 0.0, uv)
    return Texture(uv, materials.same_channels(found), number.reshape(-1))


_Read = tuple[np.ndarray, np.ndarray, list[Paint]]


def _read(file: Path) -> _Read:
    """Texture coordinates (F, 3, 2), NaN where there are none; the paint (F,) of each face, and
    the paints."""
    suffix = file.suffix.lower()
    if suffix not in _READERS:
        kind = f"{suffix[1:].upper()} files have" if suffix else "a model of the catalogue has"
        reason = f"{kind} no texture coordinates; use an OBJ or GLB file"
        raise error_in(file, "missing_uv", reason)
    check_file(file, LARGEST_FILE)
    with parsing(file, "its texture cannot be read"):
        uv, number, paints = _READERS[suffix](file)
        return np.where(np.abs(uv) < _LARGEST_UV, uv, np.nan), number, paints


def _read_obj(file: Path) -> _Read:
    obj = read_obj(file)
    corners, _ = fans(obj.polygons)
    flat = np.array([k for ring in obj.polygon_coordinates for k in ring], dtype=np.int64)
    sizes = [len(ring) for ring in obj.polygons]
    of_corner = np.repeat(np.arange(len(sizes)), sizes)
    names = list(dict.fromkeys(obj.material))
    known = materials.read_libraries(file, obj.libraries)
    paints = [known.get(name, materials.plain()) for name in names]
    number = np.array([names.index(name) for name in obj.material], dtype=np.int64)
    uv = _gathered(obj.coordinates, flat[corners])
    number = number[of_corner[corners[:, 0]]]
    return uv, number, paints


def _gathered(coordinates: Sequence[Sequence[float]], corner: np.ndarray) -> np.ndarray:
    """Rows of coordinates for corners (F, 3); NaN for -1, and for those that do not exist."""
    rows = np.array([*coordinates, (np.nan, np.nan)], dtype=np.float64)
    return rows[np.where((corner < 0) | (corner >= len(coordinates)), -1, corner)]


def _read_ply(file: Path) -> _Read:
    elements, comments = read_ply(file)
    corners, _ = fans(ply_polygons(elements["face"]))
    number = np.zeros(len(corners), dtype=np.int64)
    paint = materials.of_ply(comments, file)
    face, vertex = elements["face"], elements["vertex"]
    if "texcoord" in (face.dtype.names or ()):  # two numbers for each corner of a polygon
        rings = [np.asarray(row, dtype=np.float64).reshape(-1, 2) for row in face["texcoord"]]
        sizes = [len(ring) for ring in ply_polygons(face)]
        if [len(ring) for ring in rings] != sizes:
            raise ValueError("texcoord has not two numbers for each corner of a face")
        return np.concatenate(rings)[corners], number, [paint]
    flat = np.array([k for ring in ply_polygons(face) for k in ring], dtype=np.int64)
    names = vertex.dtype.names or ()
    for pair in (("s", "t"), ("u", "v"), ("texture_u", "texture_v")):
        if set(pair) <= set(names):
            rows = np.stack([np.asarray(vertex[key], dtype=np.float64) for key in pair], axis=1)
            return rows[flat[corners]], number, [paint]
    return np.full((len(corners), 3, 2), np.nan), number, [paint]


def _read_gltf(file: Path) -> _Read:
    parts = []
    paints: list[Paint] = []
    for k, mesh in enumerate(read_scene(file)):
        faces = np.asarray(mesh.faces, dtype=np.int64)
        given: Any = getattr(mesh.visual, "uv", None)
        uv = np.full((len(mesh.vertices), 2), np.nan) if given is None else np.asarray(given)
        parts.append((uv[:, :2].astype(np.float64)[faces], np.full(len(faces), k)))
        paints.append(materials.of_gltf(file, getattr(mesh.visual, "material", None)))
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]), paints


_READERS: dict[str, Callable[[Path], _Read]] = {
    ".obj": _read_obj,
    ".ply": _read_ply,
    ".glb": _read_gltf,
    ".gltf": _read_gltf,
}
