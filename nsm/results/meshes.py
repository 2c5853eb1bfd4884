"""Meshes with UV as OBJ or GLB."""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.results.file_faces import faces_of_file
from nsm.results.files import atomic_write
from nsm.results.glb import as_glb
from nsm.results.textures import checkerboard, checkerboard_at
from nsm.results.vertex_values import mean_by_file_vertex


class ColouredMesh(NamedTuple):
    """Vertices (V, 3), faces (F, 3), and colours (V, 3) uint8 of the vertices."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray


def painted(vertices: np.ndarray, faces: np.ndarray, source: np.ndarray) -> ColouredMesh:
    """A mesh (V, 3), (F, 3) with the colours of its vertices' places (V, 3) on the source."""
    return ColouredMesh(vertices, faces, np.round(255 * by_position(source)).astype(np.uint8))


def by_position(vertices: np.ndarray) -> np.ndarray:
    """Colours (V, 3) in [0, 1] by place in the bounding box."""
    low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0)
    return np.asarray((vertices - low) / np.maximum(extent, 1e-12))


def export_mesh(
    path: str | Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray | None,
    *,
    texture: Image.Image | None = None,
    colours: np.ndarray | None = None,
    corners: np.ndarray | None = None,
) -> None:
    """Write a mesh (V, 3), (F, 3) with its coordinates uv (V, 2) in Ω.

    A closed surface without a seam has no coordinates that are continuous on it: it goes without
    (None), and a GLB file may have colours (V, 3) in sRGB, [0, 1], at the vertices instead of a
    texture. Texture coordinates are (uv + 1) / 2, so that Ω lies within [0, 1]². A GLB file
    contains the texture; beside an OBJ file go a material file and a PNG. In an OBJ file the
    triangles' corners may have rows of uv of their own, corners (F, 3), instead of those of their
    vertices.

    Raises:
        NsmError: ``unknown_format``: the file's ending is neither .obj nor .glb.
    """
    target = Path(path)
    coordinates = None if uv is None else 0.5 * (np.asarray(uv) + 1)
    if target.suffix.lower() == ".glb":
        glb = as_glb(vertices, faces, uv=coordinates, image=texture, colours=colours)
        atomic_write(target, glb)
        return
    if target.suffix.lower() != ".obj":
        message = f"{target}: meshes are written as .obj or .glb"
        raise NsmError(message, kind="unknown_format", key=str(target))
    head = ""
    if texture is not None:
        picture = io.BytesIO()
        texture.save(picture, format="PNG")
        # a picture beside the mesh may have the mesh's name
        texture_file = target.with_name(f"{target.stem}_texture.png")
        atomic_write(texture_file, picture.getvalue())
        material = f"newmtl surface\nKd 1 1 1\nmap_Kd {texture_file.name}\n"
        atomic_write(target.with_suffix(".mtl"), material.encode())
        head = f"mtllib {target.stem}.mtl\nusemtl surface\n"
    text = head + _lines("v %.9g %.9g %.9g\n", vertices)
    if coordinates is None:
        text += _lines("f %d %d %d\n", faces + 1)
    else:
        both = np.stack([faces, faces if corners is None else corners], axis=2) + 1
        text += _lines("vt %.9g %.9g\n", coordinates) + _lines("f %d/%d %d/%d %d/%d\n", both)
    atomic_write(target, text.encode())


def _lines(form: str, rows: np.ndarray) -> str:
    """A line for each row (N, ...), all at once: one by one takes twice as long."""
    return form * len(rows) % tuple(rows.ravel().tolist())


def export_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a mesh (V, 3), (F, 3) as a binary PLY file in double precision, in the given order."""
    from plyfile import PlyData, PlyElement

    points = np.empty(len(vertices), dtype=[(axis, "f8") for axis in "xyz"])
    for axis, column in zip("xyz", np.asarray(vertices).T, strict=True):
        points[axis] = column
    triangles = np.empty(len(faces), dtype=[("vertex_indices", "i4", (3,))])
    triangles["vertex_indices"] = faces
    stream = io.BytesIO()
    elements = [PlyElement.describe(points, "vertex"), PlyElement.describe(triangles, "face")]
    PlyData(elements, byte_order="<").write(stream)
    atomic_write(path, stream.getvalue())


def export_surface(
    path: str | Path, vertices: np.ndarray, surface: Surface, uv: np.ndarray
) -> None:
    """Write a surface's mesh with other vertices (V, 3), and a checkerboard over coordinates uv
    (V, 2); arguments and errors as for :func:`export_mesh`.

    An OBJ file has the vertices and faces of the surface's file, in its order: the copies of a seam
    vertex go to their mean, and keep their own texture coordinates. A GLB file has a vertex for
    each copy. A surface on a closed domain is written whole, without coordinates. Filled holes are
    left out.
    """
    bounded = surface.domain.has_boundary
    if Path(path).suffix.lower() == ".glb":
        shown, faces = surface.shown()
        points, own = vertices[shown], uv[shown]
        if bounded:
            export_mesh(path, points, faces, own, texture=checkerboard())
        else:
            export_mesh(path, points, faces, None, colours=checkerboard_at(own))
        return
    faces, corners = faces_of_file(surface)
    points = mean_by_file_vertex(surface, vertices)
    export_mesh(path, points, faces, uv if bounded else None, corners=corners)
