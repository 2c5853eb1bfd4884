"""GLB files of a mesh with one morph target (a shape key): from the source to its image."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsm.errors import NsmError
from nsm.results.file_faces import faces_of_file
from nsm.results.files import atomic_write
from nsm.results.glb import FACES, VERTICES

if TYPE_CHECKING:
    from nsm.results.surface_map import SurfaceMap

_FLOAT, _UNSIGNED = 5126, 5125  # component types
_SECONDS = (0.0, 2.0, 4.0)
_WEIGHTS = (0.0, 1.0, 0.0)


def write_morph(path: str | Path, f: SurfaceMap) -> None:
    """Write a map's source with its image, as :meth:`SurfaceMap.export_morph` describes it."""
    image = f.target.in_original_units(f.welded_image)
    faces = faces_of_file(f.source.surface)[0]
    name = f"on {f.target.surface.name}"
    write_morph_target(path, f.source.file_mesh()[0], image, faces, name)


def write_morph_target(
    path: str | Path, vertices: np.ndarray, image: np.ndarray, faces: np.ndarray, name: str
) -> None:
    """Write a mesh that a slider, or the file's animation, moves to its image.

    Positions are in single precision, as the format has it (glTF 2.0, 3.7.2.2, Morph Targets),
    about the middle of the mesh, to which the file's node moves them: a mesh far from the origin
    keeps its digits.

    Args:
        path: a .glb file.
        vertices: (W, 3).
        image: (W, 3), where they go.
        faces: (G, 3).
        name: of the target, as programs show it.

    Raises:
        NsmError: ``unknown_format``: the file's ending is not .glb; ``out_of_range``: a length
            exceeds single precision.
        OSError: the folder cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() != ".glb":
        message = f"{target}: a mesh with a morph target is written as .glb"
        raise NsmError(message, kind="unknown_format", key=str(target))
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    with np.errstate(over="ignore"):
        start = (vertices - middle).astype("<f4")
        # what is added to the rounded start shall lead to the image
        change = (image - middle - start).astype("<f4")
    if not (np.isfinite(start).all() and np.isfinite(change).all()):
        message = f"{target}: lengths exceed single precision; scale the meshes"
        raise NsmError(message, kind="out_of_range", key=str(target))
    buffer = _Buffer()
    position = buffer.add(start, "VEC3", VERTICES, bounds=True)
    moved = buffer.add(change, "VEC3", VERTICES, bounds=True)
    corners = buffer.add(faces.astype("<u4").ravel(), "SCALAR", FACES)
    times = buffer.add(np.array(_SECONDS, "<f4"), "SCALAR", bounds=True)
    weights = buffer.add(np.array(_WEIGHTS, "<f4"), "SCALAR")
    primitive = {
        "attributes": {"POSITION": position},
        "indices": corners,
        "targets": [{"POSITION": moved}],
        "material": 0,
    }
    animation = {
        "name": name,
        "samplers": [{"input": times, "output": weights, "interpolation": "LINEAR"}],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
    }
    tree = {
        "asset": {"version": "2.0", "generator": "nsm"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": target.stem, "translation": middle.tolist()}],
        "meshes": [
            {"primitives": [primitive], "weights": [0.0], "extras": {"targetNames": [name]}}
        ],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0}}],
        "animations": [animation],
        **buffer.described(),
    }
    atomic_write(target, _glb(tree, buffer.data))


class _Buffer:
    """The binary part of a file, with its views and accessors."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, array: np.ndarray, kind: str, target: int | None = None, *, bounds: bool = False
    ) -> int:
        """Append an array (N,) or (N, 3); returns the number of its accessor."""
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view if target is None else {**view, "target": target})
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _FLOAT if array.dtype.kind == "f" else _UNSIGNED,
            "count": len(array),
            "type": kind,
        }
        if bounds:
            rows = array.reshape(len(array), -1)
            accessor["min"], accessor["max"] = rows.min(axis=0).tolist(), rows.max(axis=0).tolist()
        self.accessors.append(accessor)
        self.data += array.tobytes()  # all types have four bytes, as the alignment wants
        return len(self.accessors) - 1

    def described(self) -> dict[str, Any]:
        """What the file says about its buffer."""
        return {
            "buffers": [{"byteLength": len(self.data)}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }


def _glb(tree: dict[str, Any], data: bytes) -> bytes:
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(data)
    head = struct.pack("<4sII", b"glTF", 2, length)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    return head + chunks + struct.pack("<I4s", len(data), b"BIN\0") + data
