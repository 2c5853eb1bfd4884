"""Difficult files: damaged, with wrong headers, with unusual names, or not regular files.

Each function writes into an empty folder and returns the path for the command line.
"""

from __future__ import annotations

import base64
import gzip
import json
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from torture.shapes import REFUSED, SOLVED, Mesh, ball

FORMATS = ("obj", "off", "ply", "binary.ply", "stl", "binary.stl", "gltf", "glb")


@dataclass(frozen=True)
class File:
    """A file, the expected outcome, and a part of the message of a refusal."""

    group: str
    make: Callable[[Path], str]
    expected: str = REFUSED
    reason: str = ""


def write(mesh: Mesh, path: Path) -> None:
    """Write a mesh as OBJ, with all digits."""
    lines = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in mesh[0].tolist()]
    lines += [f"f {a} {b} {c}\n" for a, b, c in (mesh[1] + 1).tolist()]
    path.write_text("".join(lines))


def exported(mesh: Mesh, form: str) -> bytes:
    """The bytes of a mesh in one of FORMATS."""
    whole = trimesh.Trimesh(*mesh, process=False)
    if form == "ply":
        return whole.export(file_type="ply", encoding="ascii")
    if form == "stl":
        return whole.export(file_type="stl_ascii").encode()
    if form == "gltf":
        return gltf(mesh)
    data = whole.export(file_type=form.rsplit(".", 1)[-1])
    return data.encode() if isinstance(data, str) else data


def gltf(mesh: Mesh, **changes: object) -> bytes:
    """A mesh as one GLTF file with its buffer; changes replace entries, by ``array__key``."""
    points = mesh[0].astype("<f4")
    index = mesh[1].astype("<u4")
    data = points.tobytes() + index.tobytes()
    tree: dict = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": index.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": index.nbytes},
        ],
        "buffers": [
            {
                "byteLength": len(data),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode(),
            }
        ],
    }
    for name, value in changes.items():
        array, key = name.split("__")
        tree[array][0][key] = value
    return json.dumps(tree).encode()


def _name(form: str, stem: str = "mesh") -> str:
    return f"{stem}.{form.rsplit('.', 1)[-1]}"


def _raw(name: str, data: bytes, folder: Path) -> str:
    (folder / name).write_bytes(data)
    return name


def _whole(form: str, folder: Path) -> str:
    return _raw(_name(form), exported(ball(8), form), folder)


def _part(form: str, share: float, folder: Path) -> str:
    data = exported(ball(8), form)
    # not inside the last number: a text file that ends in a shorter number looks complete
    return _raw(_name(form), data[: int(share * len(data))], folder)


def _with_value(form: str, value: float, folder: Path) -> str:
    points, faces = ball(8)
    points[11, 1] = value
    return _raw(_name(form), exported((points, faces), form), folder)


LETTER = b"Dear reader,\nthis is no mesh, but 3 4 5 numbers are in it.\nf 1 2 3\nYours, v\n"


def _wrong_ply(vertices: int, faces: int, form: str, folder: Path) -> str:
    head = (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {faces}\nproperty list uchar int vertex_indices\n"
        "end_header\n"
    )
    return _raw("lies.ply", head.encode() + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", folder)


def _ply_with_long_list(folder: Path) -> str:
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
        "property float y\nproperty float z\nelement face 1\n"
        "property list uint int vertex_indices\nend_header\n"
    )
    body = np.eye(3, dtype="<f4").tobytes() + struct.pack("<I", 2**32 - 1) + b"\0" * 12
    return _raw("list.ply", head.encode() + body, folder)


def _wrong_stl(folder: Path) -> str:
    return _raw("lies.stl", b"\0" * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 50, folder)


def _wrong_off(vertices: int, faces: int, folder: Path) -> str:
    return _raw("lies.off", f"OFF\n{vertices} {faces} 0\n0 0 0\n1 0 0\n".encode(), folder)


def _wrong_glb(folder: Path) -> str:
    data = bytearray(exported(ball(8), "glb"))
    data[12:16] = struct.pack("<I", 2**32 - 16)
    return _raw("lies.glb", bytes(data), folder)


def _gltf_changed(folder: Path, **changes: object) -> str:
    return _raw("changed.gltf", gltf(ball(8), **changes), folder)


def _gltf_of_zeros(folder: Path) -> str:
    """An accessor without a buffer view stands for any number of zeros."""
    tree = json.loads(gltf(ball(8)))
    tree["accessors"][0] = {"componentType": 5126, "count": 2**40, "type": "VEC3"}
    return _raw("zeros.gltf", json.dumps(tree).encode(), folder)


def _gltf_with_many_copies(folder: Path) -> str:
    """Eight levels of ten children each: a hundred million copies of one mesh."""
    tree = json.loads(gltf(ball(8)))
    tree["nodes"] = [{"children": [k + 1] * 10} for k in range(8)] + [{"mesh": 0}]
    return _raw("copies.gltf", json.dumps(tree).encode(), folder)


def _gltf_with_outer_file(uri: str, folder: Path) -> str:
    (folder / "secret.bin").write_bytes(bytes(10_000))
    (folder / "inner").mkdir()
    tree = json.loads(gltf(ball(8)))
    tree["buffers"][0]["uri"] = uri.format(folder=folder)
    return _raw("inner/outer.gltf", json.dumps(tree).encode(), folder)


def _gzipped(folder: Path) -> str:
    return _raw("packed.obj", gzip.compress(exported(ball(8), "obj")), folder)


def _encoded(encoding: str, folder: Path) -> str:
    return _raw("wide.obj", exported(ball(8), "obj").decode().encode(encoding), folder)


def _with_byte_order_mark(folder: Path) -> str:
    return _raw("mark.off", b"\xef\xbb\xbf" + exported(ball(8), "off"), folder)


def _polygon(corners: int, folder: Path) -> str:
    angle = 2 * np.pi * np.arange(corners) / corners
    lines = [f"v {float(np.cos(t))!r} {float(np.sin(t))!r} 0" for t in angle.tolist()]
    ring = " ".join(map(str, range(1, corners + 1)))
    return _raw("polygon.obj", "\n".join([*lines, f"f {ring}"]).encode(), folder)


def _faces(lines: str, folder: Path) -> str:
    text = f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nf 1 2 3\nf 2 4 3\n{lines}\n"
    return _raw("faces.obj", text.encode(), folder)


def _named(name: str | bytes, folder: Path) -> str:
    path = os.path.join(os.fsencode(folder), os.fsencode(name))
    with open(path, "wb") as stream:
        stream.write(exported(ball(8), "obj"))
    return os.fsdecode(name)


def _folder_as_file(folder: Path) -> str:
    (folder / "folder.obj").mkdir()
    return "folder.obj"


def _pipe(folder: Path) -> str:
    os.mkfifo(folder / "pipe.obj")
    return "pipe.obj"


def _link(target: str, name: str, folder: Path) -> str:
    (folder / name).symlink_to(target)
    return name


_TAKEN = {"not UTF-8": (REFUSED, "not UTF-8"), "with ${}": (REFUSED, "'${' is not accepted")}

FILES: dict[str, File] = {
    **{f"{f}: whole": File("whole files", partial(_whole, f), SOLVED) for f in FORMATS},
    **{f"{f}: empty": File("empty files", partial(_raw, _name(f), b"")) for f in FORMATS},
    **{
        f"{f}: first {share:.0%}": File("truncated files", partial(_part, f, share))
        for f in FORMATS
        for share in (0.01, 0.2, 0.5, 0.98)
        # OBJ says nowhere how long it is: cut between two lines it is a mesh with holes
        if f != "obj" or share < 0.3
    },
    **{f"{f}: a letter": File("no meshes", partial(_raw, _name(f), LETTER)) for f in FORMATS},
    **{
        f"{f}: noise": File(
            "no meshes", partial(_raw, _name(f), np.random.default_rng(6).bytes(5000))
        )
        for f in ("obj", "off", "ply", "stl", "gltf", "glb")
    },
    **{
        f"{f}: {word}": File("NaN and inf", partial(_with_value, f, float(word)), REFUSED, "NaN or")
        for f in ("obj", "off", "ply", "binary.ply", "binary.stl", "gltf", "glb")
        for word in ("nan", "inf")
    },
    "PLY of 2e9 vertices, binary": File(
        "headers that lie", partial(_wrong_ply, 2 * 10**9, 1, "binary_little_endian")
    ),
    "PLY of 2e9 vertices, ascii": File(
        "headers that lie", partial(_wrong_ply, 2 * 10**9, 1, "ascii")
    ),
    "PLY of 1e18 faces": File(
        "headers that lie", partial(_wrong_ply, 3, 10**18, "binary_little_endian")
    ),
    "PLY of -1 vertices": File("headers that lie", partial(_wrong_ply, -1, 1, "ascii")),
    "PLY face of 4e9 corners": File("headers that lie", _ply_with_long_list),
    "STL of 4e9 faces": File("headers that lie", _wrong_stl),
    "OFF of 1e12 vertices": File("headers that lie", partial(_wrong_off, 10**12, 10)),
    "OFF of -3 vertices": File("headers that lie", partial(_wrong_off, -3, -2)),
    "GLB chunk of 4 GB": File("headers that lie", _wrong_glb),
    "GLTF accessor of 1e12": File(
        "headers that lie", partial(_gltf_changed, accessors__count=2**40)
    ),
    "GLTF accessor of 1e12 zeros": File("headers that lie", _gltf_of_zeros),
    "GLTF view beyond its buffer": File(
        "headers that lie", partial(_gltf_changed, bufferViews__byteOffset=10**9)
    ),
    "GLTF buffer that is missing": File(
        "headers that lie", partial(_gltf_changed, buffers__uri="not-there.bin")
    ),
    "GLTF node within itself": File(
        "headers that lie", partial(_gltf_changed, nodes__children=[0])
    ),
    "GLTF of 1e8 copies": File("headers that lie", _gltf_with_many_copies),
    "GLTF buffer ../secret.bin": File(
        "outer files", partial(_gltf_with_outer_file, "../secret.bin")
    ),
    "GLTF buffer of whole path": File(
        "outer files", partial(_gltf_with_outer_file, "{folder}/secret.bin")
    ),
    "GLTF buffer file://": File(
        "outer files", partial(_gltf_with_outer_file, "file://{folder}/secret.bin")
    ),
    "GLTF buffer http://": File(
        "outer files", partial(_gltf_with_outer_file, "http://127.0.0.1:9/secret.bin")
    ),
    "OBJ, gzipped": File("encodings", _gzipped),
    "OBJ in UTF-16": File("encodings", partial(_encoded, "utf-16")),
    "OBJ in EBCDIC": File("encodings", partial(_encoded, "cp037")),
    "OFF with a byte order mark": File("encodings", _with_byte_order_mark, SOLVED),
    "polygon of 5000 corners": File("polygons", partial(_polygon, 5000), SOLVED),
    "polygon of 2 corners": File("polygons", partial(_faces, "f 1 2")),
    "polygon of one vertex": File("polygons", partial(_faces, "f 1 1 1 1"), SOLVED),
    "face of vertex 1e30": File("polygons", partial(_faces, "f 1 2 " + "9" * 30)),
    "face of vertex 1e6000": File("polygons", partial(_faces, "f 1 2 " + "9" * 6000)),
    "face of vertex 1.5": File("polygons", partial(_faces, "f 1 2 1.5")),
    **{
        f"name {shown}": File("names", partial(_named, name), *_TAKEN.get(shown, (SOLVED,)))
        for shown, name in {
            "not UTF-8": b"caf\xe9.obj",
            "with spaces": "two  words .obj",
            "in Greek": "επιφάνεια.obj",
            "with = and ,": "a=b,c.obj",
            "with brackets": "a[1]{2}(3).obj",
            "with quotes": 'it\'s "it".obj',
            "with ${}": "${oc.env:HOME}.obj",
            "with a new line": "two\nlines.obj",
            "with a dash first": "-rf.obj",
            "with [red]": "[red]x[bold.obj",
            "of 250 characters": "m" * 246 + ".obj",
            "in capitals": "MESH.OBJ",
        }.items()
    },
    "a folder": File("no files", _folder_as_file),
    "a named pipe": File("no files", _pipe),
    "a link to /dev/zero": File("no files", partial(_link, "/dev/zero", "zero.obj")),
    "a link to itself": File("no files", partial(_link, "round.obj", "round.obj")),
    "a link to nowhere": File("no files", partial(_link, "nowhere.obj", "dead.obj")),
    "/dev/full": File("no files", partial(_link, "/dev/full", "full.ply")),
}
