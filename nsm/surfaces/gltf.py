"""Checks of glTF files from untrusted sources, before they are read.

A glTF file names further files, the sizes of its arrays and the number of instances of a mesh.
All of them may be wrong, or an attack.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from nsm.surfaces.folder_files import read_below

_LARGEST_JSON = 100 * 2**20  # bytes
_MOST_NODES = 10_000  # of a scene, with repetitions
_DEEPEST = 100  # nested nodes
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_UNMOVED = {"offset": [0, 0], "scale": [1, 1], "rotation": 0, "texCoord": 0}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def check_gltf(file: Path) -> None:
    """Check the sizes and the node tree of a glTF or GLB file.

    Raises:
        ValueError: arrays without data or larger than their data, cycles of nodes, or too many
            nodes.
    """
    tree = _tree(file)
    views = _listed(tree, "bufferViews")
    for accessor in _listed(tree, "accessors"):
        count = _number(accessor, "count")
        width = _BYTES.get(accessor.get("componentType", 0), 1)
        size = count * width * _COMPONENTS.get(str(accessor.get("type")), 1)
        if "bufferView" not in accessor:
            raise ValueError("an accessor has no bufferView")
        k = _number(accessor, "bufferView")
        if k >= len(views) or size > _number(views[k], "byteLength"):
            raise ValueError(f"an accessor of {size} bytes exceeds its bufferView")
    nodes = _listed(tree, "nodes")
    for scene in _listed(tree, "scenes"):
        left = _MOST_NODES
        stack = [(child, 0) for child in scene.get("nodes", [])]
        while stack:
            k, depth = stack.pop()
            left -= 1
            if left < 0 or depth > _DEEPEST:
                raise ValueError(f"more than {_MOST_NODES} nodes, or a cycle of nodes")
            if not isinstance(k, int) or not 0 <= k < len(nodes):
                raise ValueError("a node is missing")
            stack += [(child, depth + 1) for child in nodes[k].get("children", [])]


def check_images(file: Path) -> None:
    """Check that the image files of a glTF or GLB file are there: trimesh would leave them out.

    Raises:
        ValueError: one is missing, or outside the folder.
    """
    for image in _listed(_tree(file), "images"):
        place = str(image.get("uri", "data:"))
        if not place.startswith("data:"):
            read_below(file.parent, place)


def check_textures(file: Path) -> None:
    """Check that base-colour images are placed by the first texture coordinates as they are.

    Raises:
        ValueError: by a second set of them, or moved by KHR_texture_transform, which trimesh does
            not know.
    """
    for material in _listed(_tree(file), "materials"):
        texture = _mapping(_mapping(material, "pbrMetallicRoughness"), "baseColorTexture")
        if texture.get("texCoord", 0) != 0:
            raise ValueError("an image has texture coordinates other than the first ones")
        moved = _mapping(_mapping(texture, "extensions"), "KHR_texture_transform")
        if any(moved.get(key, plain) != plain for key, plain in _UNMOVED.items()):
            raise ValueError("an image is moved (KHR_texture_transform); apply that to the UV")


def _mapping(item: dict[str, Any], key: str) -> dict[str, Any]:
    value = item.get(key)
    return value if isinstance(value, dict) else {}


def _tree(file: Path) -> dict[str, Any]:
    with file.open("rb") as stream:
        data = stream.read(20)
        if file.suffix.lower() == ".glb":
            if len(data) < 20 or data[:4] != b"glTF":
                raise ValueError("no GLB header")
            length = struct.unpack("<I", data[12:16])[0]
            if not 0 < length <= min(_LARGEST_JSON, file.stat().st_size):
                raise ValueError(f"the JSON chunk of {length} bytes is truncated or too large")
            text = stream.read(length)
        else:
            if file.stat().st_size > 2 * _LARGEST_JSON:
                raise ValueError(f"larger than {2 * _LARGEST_JSON} bytes; use GLB")
            text = data + stream.read()
    tree = json.loads(text)
    if not isinstance(tree, dict):
        raise ValueError("not glTF")
    return tree


def _listed(tree: dict[str, Any], key: str) -> list[dict[str, Any]]:
    items = tree.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise ValueError(f"{key} is not a list of objects")
    return items


def _number(item: dict[str, Any], key: str) -> int:
    value = item.get(key)
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"{key} is {value!r}")
    return value
