"""OBJ files: vertices, polygons, texture coordinates and the names of materials."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple


class Obj(NamedTuple):
    """What an OBJ file says of a mesh and its texture.

    Attributes:
        vertices: three coordinates each.
        polygons: the vertices of each polygon.
        coordinates: texture coordinates, two each, NaN where they are damaged.
        polygon_coordinates: for each corner of each polygon its texture coordinate, -1 for none.
        material: the name of each polygon's material, or "".
        libraries: names of the material files.
    """

    vertices: list[list[float]]
    polygons: list[list[int]]
    coordinates: list[list[float]]
    polygon_coordinates: list[list[int]]
    material: list[str]
    libraries: list[str]


def read_obj(file: Path) -> Obj:
    """Read an OBJ file.

    Raises:
        ValueError: it is damaged.
    """
    obj, material = Obj([], [], [], [], [], []), ""
    text = text_of(file).replace("\\\r\n", " ").replace("\\\n", " ")  # continued lines
    for line in text.splitlines():
        fields = line.split("#")[0].split()
        word = fields[0] if fields else ""
        if word == "v":
            obj.vertices.append([float(field) for field in fields[1:4]])
        elif word == "vt":
            obj.coordinates.append(_coordinates(fields))
        elif word == "f":
            corners = [field.split("/") for field in fields[1:]]
            obj.polygons.append([_vertex(c[0], len(obj.vertices)) for c in corners])
            obj.polygon_coordinates.append([_coordinate(c, len(obj.coordinates)) for c in corners])
            obj.material.append(material)
        elif word == "usemtl":
            material = line.split(None, 1)[1].strip() if len(fields) > 1 else ""
        elif word == "mtllib" and len(fields) > 1:
            obj.libraries.append(line.split(None, 1)[1].strip())
    return obj


def _vertex(field: str, count: int) -> int:
    """A vertex of a face: OBJ counts from 1; negative ones count back from the last one read."""
    index = int(field)
    if index == 0:
        raise ValueError("a face uses vertex 0, but OBJ counts from 1")
    return index - 1 if index > 0 else count + index


# Texture coordinates that cannot be read leave the mesh as it is: they only matter to textures.


def _coordinate(corner: list[str], count: int) -> int:
    try:
        index = int(corner[1])
    except (IndexError, ValueError):
        return -1
    return index - 1 if index > 0 else max(count + index, -1) if index else -1


def _coordinates(fields: list[str]) -> list[float]:
    try:
        u, v = (float(field) for field in (*fields[1:3], "0")[:2])
    except ValueError:
        return [math.nan, math.nan]
    return [u, v]


def text_of(file: Path) -> str:
    """The text of a file.

    Raises:
        ValueError: binary data.
    """
    raw = file.read_bytes()
    if b"\0" in raw[:4096]:
        raise ValueError("binary data where text is expected")
    return raw.decode("utf-8-sig", errors="replace")
