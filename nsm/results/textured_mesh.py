"""Meshes with a texture: painted by a map from another mesh, and written to files."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from nsm.errors import NsmError
from nsm.results.baking import atlas_fault, baked, padded
from nsm.results.file_faces import FileFaces
from nsm.results.files import atomic_write
from nsm.results.glb import as_glb
from nsm.surfaces.atlas import unwrapped
from nsm.surfaces.catalogue import catalogue_mesh
from nsm.surfaces.loading import is_mesh_path, load_mesh
from nsm.surfaces.location import Places
from nsm.surfaces.textures import Texture, read_texture, read_uv

if TYPE_CHECKING:
    from nsm.results.surface_map import SurfaceMap

LARGEST_SIZE = 8192  # texels a side


@dataclass(frozen=True, eq=False)
class FileMesh:
    """The mesh of a file, as it is there.

    Attributes:
        name: of the file, in messages.
        vertices, faces: (V, 3) and (F, 3).
        uv: (F, 3, 2) texture coordinates at the corners of the faces, or None.
    """

    name: str
    vertices: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    uv: np.ndarray | None = field(default=None, repr=False)


def read_file_mesh(path_or_name: str | Path) -> FileMesh:
    """The mesh of a file, or of the catalogue, with its texture coordinates if it has them.

    Raises:
        NsmError: as :func:`nsm.surfaces.loading.load_mesh` and
            :func:`nsm.surfaces.catalogue.catalogue_mesh`.
    """
    text = str(path_or_name)
    if not (is_mesh_path(text) or os.sep in text):
        return FileMesh(text, *catalogue_mesh(text))
    vertices, faces, _ = load_mesh(text)
    return FileMesh(text, vertices, faces, read_uv(text))


_NOTHING = 204.0  # grey and opaque, where the map takes no point


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh with one image.

    Attributes:
        vertices, faces: (V, 3) and (F, 3) of the mesh file.
        uv: (F, 3, 2) texture coordinates at the corners of the faces; (0, 0) is the lower left
            corner of the image.
        image: (H, W, 3) or (H, W, 4) uint8, sRGB.
        log: what was done, a line each.
    """

    vertices: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    uv: np.ndarray = field(repr=False)
    image: np.ndarray = field(repr=False)
    log: tuple[str, ...] = ()

    def export(self, path: str | Path) -> None:
        """Write the mesh.

        OBJ: the vertices and faces in their order, beside them NAME.mtl and NAME.png. GLB: one file
        in single precision; a vertex at a seam of the texture is written once for each side.

        Raises:
            NsmError: ``unknown_format``: the file's ending is neither .obj nor .glb.
            OSError: the folder cannot be written.
        """
        target = Path(path)
        writer = {".obj": self._write_obj, ".glb": self._write_glb}.get(target.suffix.lower())
        if writer is None:
            message = f"{target}: textured meshes are written as .obj or .glb"
            raise NsmError(message, kind="unknown_format", key=str(target))
        writer(target)

    def _corners(self) -> tuple[np.ndarray, np.ndarray]:
        """The different texture coordinates (T, 2), and those (F, 3) of each corner."""
        uv, number = np.unique(self.uv.reshape(-1, 2), axis=0, return_inverse=True)
        return uv, number.reshape(-1, 3)

    def _write_obj(self, target: Path) -> None:
        picture = io.BytesIO()
        Image.fromarray(self.image).save(picture, format="PNG")
        atomic_write(target.with_suffix(".png"), picture.getvalue())
        material = f"newmtl textured\nKd 1 1 1\nmap_Kd {target.stem}.png\n"
        atomic_write(target.with_suffix(".mtl"), material.encode())
        uv, number = self._corners()
        lines = [f"mtllib {target.stem}.mtl\n"]
        lines += [f"v {x!r} {y!r} {z!r}\n" for x, y, z in self.vertices.tolist()]
        lines += [f"vt {u:.9g} {v:.9g}\n" for u, v in uv.tolist()]
        lines.append("usemtl textured\n")
        rows = np.stack([self.faces + 1, number + 1], axis=2).reshape(-1, 6).tolist()
        lines += ["f {}/{} {}/{} {}/{}\n".format(*row) for row in rows]
        atomic_write(target, "".join(lines).encode())

    def _write_glb(self, target: Path) -> None:
        uv, number = self._corners()
        pairs = np.stack([self.faces, number], axis=2).reshape(-1, 2)
        split, corner = np.unique(pairs, axis=0, return_inverse=True)
        glb = as_glb(
            self.vertices[split[:, 0]],
            corner.reshape(-1, 3),
            uv=uv[split[:, 1]],
            image=Image.fromarray(self.image),
        )
        atomic_write(target, glb)


def painted_by(
    f: SurfaceMap,
    source: str | Path,
    target: str | Path,
    *,
    texture: str | Path | None,
    back: bool,
    size: int,
) -> TexturedMesh:
    """The texture of one mesh file on the other, as :meth:`SurfaceMap.bake` describes it."""
    if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= LARGEST_SIZE:
        message = f"size: {size!r} is not a whole number from 1 to {LARGEST_SIZE}"
        raise NsmError(message, kind="out_of_range", key="size")
    ends = [target, source] if back else [source, target]
    paint = read_texture(ends[0], texture)
    start, end = (read_file_mesh(one) for one in ends)
    return painted(f, start, paint, end, back=back, size=size)


def painted(
    f: SurfaceMap,
    start: FileMesh,
    texture: Texture,
    end: FileMesh,
    *,
    back: bool = False,
    size: int = 1024,
) -> TexturedMesh:
    """The texture of one mesh, baked to the other by a map.

    Each texel shows a point of the mesh ``end``; it takes the colour that its preimage on
    ``start`` has.

    Args:
        f: the map.
        start: the mesh that the texture is on: f's source, or with ``back`` its target.
        texture: of ``start``.
        end: the other mesh. Its own texture coordinates serve where they are an atlas; otherwise
            its charts are laid out anew, which the log says.
        back: from target to source.
        size: texels a side of the new image.

    Raises:
        NsmError: ``wrong_mesh``: the map's surfaces were made from other meshes.
    """
    first, last = f.source.surface, f.target.surface
    if back:
        first, last = last, first
    there = FileFaces(last, end.vertices, end.faces, end.name)
    here = FileFaces(first, start.vertices, start.faces, start.name)
    texture = padded(texture)
    uv, log = _atlas(end, size)

    def colours(face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        places = here.to_file(f.places(there.to_surface(Places(face, weights)), back=not back))
        known = places.face >= 0
        if known.all():
            return texture.colours(*places)
        some = texture.colours(places.face[known], places.weights[known])
        result = np.full((len(known), some.shape[1]), _NOTHING)
        result[:, 3:] = 255.0
        result[known] = some
        return result

    return TexturedMesh(end.vertices, end.faces, uv, baked(uv, colours, size), log)


def _atlas(mesh: FileMesh, size: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """Texture coordinates (F, 3, 2) that colours can be baked into, and what to say of them."""
    fault: str | None = "no texture coordinates"
    if mesh.uv is not None:
        fault = atlas_fault(mesh.uv, mesh.vertices[mesh.faces], size)
        if fault is None:
            return mesh.uv, (f"{mesh.name}: baked into its own texture coordinates",)
    uv = unwrapped(mesh.vertices, mesh.faces, size=size, name=mesh.name)
    return uv, (f"{mesh.name}: baked into a new atlas ({fault})",)
