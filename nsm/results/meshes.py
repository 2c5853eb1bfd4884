"""Meshes with UV as OBJ or GLB."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from nsm.errors import NsmError
from nsm.results.files import atomic_write

if TYPE_CHECKING:
    import trimesh


def export_mesh(
    path: str | Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    *,
    texture: Image.Image | None = None,
    uv_faces: np.ndarray | None = None,
) -> None:
    """Write a mesh (V, 3), (F, 3) with its coordinates uv (V, 2) in Ω.

    Texture coordinates are (uv + 1) / 2, so that Ω lies within [0, 1]². A GLB file contains the
    texture; beside an OBJ file go a material file and a PNG.

    Args:
        path: of the file.
        vertices, faces, uv: the mesh.
        texture: a picture on it.
        uv_faces: (F, 3) rows of uv for the corners of the faces, where a vertex has several. A GLB
            file cannot have them: its vertices get the texture's colours.

    Raises:
        NsmError: ``unknown_format``: the file's ending is neither .obj nor .glb.
    """
    target = Path(path)
    coordinates = 0.5 * (np.asarray(uv) + 1)
    uv_faces = faces if uv_faces is None else uv_faces
    if target.suffix.lower() == ".glb":
        if uv_faces is faces:
            data = _glb(vertices, faces, coordinates, texture)
        else:
            data = _coloured_glb(vertices, faces, coordinates, uv_faces, texture)
        atomic_write(target, data)
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
    lines = [head]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices.tolist()]
    lines += [f"vt {u:.9g} {v:.9g}\n" for u, v in coordinates.tolist()]
    lines += [
        f"f {a}/{s} {b}/{t} {c}/{u}\n"
        for (a, b, c), (s, t, u) in zip((faces + 1).tolist(), (uv_faces + 1).tolist(), strict=True)
    ]
    atomic_write(target, "".join(lines).encode())


def _glb(
    vertices: np.ndarray, faces: np.ndarray, coordinates: np.ndarray, texture: Image.Image | None
) -> bytes:
    import trimesh

    visual = trimesh.visual.TextureVisuals(uv=coordinates, image=texture)
    return _exported(trimesh.Trimesh(vertices, faces, visual=visual, process=False))


def _coloured_glb(
    vertices: np.ndarray,
    faces: np.ndarray,
    coordinates: np.ndarray,
    uv_faces: np.ndarray,
    texture: Image.Image | None,
) -> bytes:
    import trimesh

    colours = None
    if texture is not None:
        at = np.zeros((len(vertices), 2))
        at[faces] = coordinates[uv_faces]
        pixels = np.asarray(texture.convert("RGB"))
        size = np.array(pixels.shape[1::-1])
        column, row = (np.mod(at * (1, -1), 1.0) * size).astype(np.int64).clip(0, size - 1).T
        colours = pixels[row, column]
    return _exported(trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False))


def _exported(mesh: trimesh.Trimesh) -> bytes:
    import trimesh

    data = trimesh.Scene(mesh).export(file_type="glb")
    assert isinstance(data, bytes)
    return data
