"""Textures of mesh files, baked to the other mesh of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline.resolve_inputs import Shape
from nsm.results import SurfaceMap
from nsm.results.textured_mesh import FileMesh, painted
from nsm.surfaces.loading import is_mesh_path
from nsm.surfaces.textures import Texture, read_texture, read_uv

OWN = "own"  # the setting's word for the materials of the files


@dataclass(frozen=True)
class Textures:
    """The meshes of a map, and the textures to bake.

    Attributes:
        source, target: the meshes of the files.
        of_source, of_target: their textures, or None.
    """

    source: FileMesh
    target: FileMesh
    of_source: Texture | None
    of_target: Texture | None


def read_textures(
    setting: str | None, ends: Sequence[Any], shapes: Sequence[Shape]
) -> Textures | None:
    """What the setting ``texture`` asks for.

    Args:
        setting: None; an image for the source; or :data:`OWN`, the source's own.
        ends: what the user names as source and target.
        shapes: what that is.

    Raises:
        NsmError: ``wrong_type``: an end that is no mesh file or mesh of the catalogue;
            ``missing_texture``: neither file has one; or as
            :func:`nsm.surfaces.textures.read_texture`.
    """
    if setting is None:
        return None
    meshes = []
    for key, end, shape in zip(("source", "target"), ends, shapes, strict=True):
        if not isinstance(shape, Mesh):
            raise NsmError(
                f"texture: {key} is no mesh file; give one, or call f.bake(source, target) with "
                "the files",
                kind="wrong_type",
                key="texture",
            )
        uv = read_uv(end) if is_mesh_path(str(end)) else None
        meshes.append(FileMesh(str(end), shape.vertices, shape.faces, uv))
    source, target = ends
    mine = _own(source) if setting == OWN else read_texture(source, setting)
    other = _own(target)
    if mine is None and other is None:
        read_texture(source)  # says what is missing
    return Textures(meshes[0], meshes[1], mine, other)


def _own(path: str | Path) -> Texture | None:
    """The texture of a file, or None if it has no image."""
    if not is_mesh_path(str(path)):
        return None
    try:
        return read_texture(path)
    except NsmError as error:
        if error.kind in ("missing_texture", "missing_uv"):
            return None
        raise


def write_textured(textures: Textures, folder: Path, f: SurfaceMap, size: int) -> list[str]:
    """Write target_textured and source_textured as OBJ and GLB; returns a line on each."""
    lines: list[str] = []
    ways = (
        ("target", textures.source, textures.of_source, textures.target, False),
        ("source", textures.target, textures.of_target, textures.source, True),
    )
    for name, start, texture, end, back in ways:
        if texture is None:
            continue
        mesh = painted(f, start, texture, end, back=back, size=size)
        for ending in ("obj", "glb"):
            mesh.export(folder / f"{name}_textured.{ending}")
        lines += [f"  texture on the {name}, {line}" for line in mesh.log]
    return lines
