"""What a glTF file asks for, looked at before it is given: files beside it, and memory.

A glTF file names further files, says how many numbers it holds, and how often a part is repeated.
From a stranger, each may be a lie.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from trimesh.resolvers import Resolver

_LARGEST_JSON = 100 * 2**20  # bytes
_MOST_INSTANCES = 10_000  # of meshes in a scene
_DEEPEST = 100  # nodes within nodes
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


class Beside(Resolver):
    """Files that a mesh file names, from its own folder and the folders in it alone.

    Args:
        folder: of the mesh file.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()

    def get(self, key: str) -> bytes:
        """The contents of a file.

        Raises:
            ValueError: it lies elsewhere, or is no regular file.
        """
        file = (self.folder / unquote(str(key))).resolve()
        if not file.is_relative_to(self.folder):
            raise ValueError(f"it names {key!r}, which is outside of its folder")
        if not file.is_file():
            raise ValueError(f"it names {key!r}, and there is no such file")
        return file.read_bytes()

    def write(self, name: str, data: bytes) -> None:
        """Nothing is written."""
        raise ValueError("reading a mesh writes nothing")

    def namespaced(self, namespace: str) -> Beside:
        """The same for a folder in this one."""
        return Beside(self.folder / namespace)

    def keys(self) -> list[str]:
        """No list is given."""
        return []


def check_gltf(file: Path) -> None:
    """Look at what a GLTF or GLB file announces.

    Raises:
        ValueError: arrays that are not stored, whose size is made up, parts within themselves, or
            too many copies of them.
    """
    tree = _tree(file)
    views = _listed(tree, "bufferViews")
    for accessor in _listed(tree, "accessors"):
        count = _number(accessor, "count")
        width = _BYTES.get(accessor.get("componentType", 0), 1)
        size = count * width * _COMPONENTS.get(str(accessor.get("type")), 1)
        if "bufferView" not in accessor:
            raise ValueError("an array of it is not stored")
        k = _number(accessor, "bufferView")
        if k >= len(views) or size > _number(views[k], "byteLength"):
            raise ValueError(f"an array of {size} bytes is announced, and not there")
    nodes = _listed(tree, "nodes")
    for scene in _listed(tree, "scenes"):
        left = _MOST_INSTANCES
        stack = [(child, 0) for child in scene.get("nodes", [])]
        while stack:
            k, depth = stack.pop()
            left -= 1
            if left < 0 or depth > _DEEPEST:
                raise ValueError(f"more than {_MOST_INSTANCES} parts, or parts within themselves")
            if not isinstance(k, int) or not 0 <= k < len(nodes):
                raise ValueError("a part of it is not there")
            stack += [(child, depth + 1) for child in nodes[k].get("children", [])]


def _tree(file: Path) -> dict[str, Any]:
    with file.open("rb") as stream:
        data = stream.read(20)
        if file.suffix.lower() == ".glb":
            if len(data) < 20 or data[:4] != b"glTF":
                raise ValueError("no GLB header")
            length = struct.unpack("<I", data[12:16])[0]
            if not 0 < length <= min(_LARGEST_JSON, file.stat().st_size):
                raise ValueError(f"{length} bytes of JSON announced, and not there")
            text = stream.read(length)
        else:
            if file.stat().st_size > 2 * _LARGEST_JSON:
                raise ValueError(f"larger than {2 * _LARGEST_JSON} bytes; use GLB")
            text = data + stream.read()
    tree = json.loads(text)
    if not isinstance(tree, dict):
        raise ValueError("no glTF")
    return tree


def _listed(tree: dict[str, Any], key: str) -> list[dict[str, Any]]:
    items = tree.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise ValueError(f"{key} is no list of objects")
    return items


def _number(item: dict[str, Any], key: str) -> int:
    value = item.get(key)
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{key} is {value!r}")
    return value
