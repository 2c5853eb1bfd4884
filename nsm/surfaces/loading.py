"""Read a mesh file into vertices and triangles, in the file's own vertex order.

OBJ and OFF are read here, line by line, because general loaders split or reorder vertices
at texture seams, and users name landmarks by the vertex numbers of their file. PLY goes through
plyfile (ascii, binary, triangle strips); STL and glTF through trimesh.
"""

from __future__ import annotations

import stat
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nsm.errors import NsmError

_LONGEST_HEADER = 100_000  # bytes
LARGEST_FILE = 4 * 2**30  # bytes
EXTENSIONS = (".obj", ".ply", ".off", ".stl", ".gltf", ".glb")


def load_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Vertices (V,3) float64, triangles (F,3) int64 and a log of what was converted.

    Vertices are in the order of the file, in the file's units. NsmError if the file is missing,
    of an unknown kind, unreadable, without faces, or holds NaN, infinities or bad indices.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    try:
        status = file.stat()
    except FileNotFoundError:
        raise NsmError(f"{file}: no such file; check the path") from None
    except (OSError, ValueError) as error:  # too long, a loop of links, not allowed, a NUL in it
        reason = getattr(error, "strerror", None) or "not a path"
        raise NsmError(f"{file}: {reason}; check the path") from error
    if stat.S_ISDIR(status.st_mode):
        raise NsmError(f"{file}: is a folder; give a mesh file")
    if suffix not in EXTENSIONS:
        raise NsmError(
            f"{file}: unknown mesh format '{suffix}'; use one of {', '.join(EXTENSIONS)}"
        )
    if not stat.S_ISREG(status.st_mode):  # a pipe would be waited for, a device read for ever
        raise NsmError(f"{file}: not a regular file; give a mesh file")
    if status.st_size > LARGEST_FILE:
        raise NsmError(
            f"{file}: larger than {LARGEST_FILE / 2**30:.0f} GB; simplify the mesh before"
        )
    reader = {".obj": _read_obj, ".off": _read_off, ".ply": _read_ply}.get(suffix, _read_trimesh)
    try:
        vertices, faces, log = reader(file)
    except NsmError:
        raise
    except Exception as error:  # parsers raise anything at all on broken files
        reason = " ".join(str(error).split())[:150] or type(error).__name__
        raise NsmError(
            f"{file}: not a readable {suffix[1:].upper()} mesh ({reason}); "
            "it may be truncated or of another format: export it again"
        ) from error
    check_arrays(vertices, faces, str(file))
    return vertices, faces, tuple(log)


def as_arrays(vertices: Any, faces: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as float64 and faces as int64; NsmError for what is no real, or no whole, number."""
    try:
        vertices, given = np.asarray(vertices), np.asarray(faces)
        if vertices.dtype.kind not in "fiub" or given.dtype.kind not in "fiub":
            raise ValueError
        with np.errstate(invalid="ignore"):
            faces = given.astype(np.int64)
        if not np.array_equal(faces, given):
            raise ValueError
    except (TypeError, ValueError) as error:
        raise NsmError(
            f"{name}: vertices must be real numbers (V, 3), and faces whole ones (F, 3)"
        ) from error
    return vertices.astype(np.float64), faces


def check_arrays(vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    """NsmError unless vertices are (V,3) finite and faces (F,3) valid indices, F > 0."""
    for what, array in (("vertices", vertices), ("faces", faces)):
        if array.size and (array.ndim != 2 or array.shape[1] != 3):
            raise NsmError(
                f"{name}: {what} of shape {array.shape}; give points in space (V, 3) and triangles "
                "(F, 3)"
            )
    if vertices.size == 0:
        raise NsmError(f"{name}: holds no 3D vertices; export it again as a triangle mesh")
    if faces.size == 0:
        raise NsmError(f"{name}: holds no faces (a point cloud or text?); give a triangle mesh")
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise NsmError(f"{name}: vertex {bad} is NaN or infinite; repair it in a mesh editor")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise NsmError(
            f"{name}: a face names vertex {int(faces.max() if faces.min() >= 0 else faces.min())}"
            f" but there are {len(vertices)}; the file is truncated or damaged: export it again"
        )


_Read = tuple[np.ndarray, np.ndarray, list[str]]


def _fan(polygons: Iterable[Sequence[int]]) -> tuple[np.ndarray, int]:
    """Triangles of polygons by fans, and how many polygons had more than three corners."""
    rings = [list(polygon) for polygon in polygons]
    if any(len(ring) < 3 for ring in rings):
        raise ValueError("a face has fewer than three corners")
    larger = [ring for ring in rings if len(ring) > 3]
    if larger:
        # Two quads may share two sides; the same diagonal in both would be an edge of four
        # triangles, so a quad whose diagonal is taken is split along its other one.
        taken = {frozenset(side) for r in rings for side in zip(r, r[1:] + r[:1], strict=True)}
        for ring in larger:
            if frozenset((ring[0], ring[2])) in taken:
                ring.append(ring.pop(0))
            taken.update(frozenset((ring[0], corner)) for corner in ring[2:-1])
    triangles = [(ring[0], ring[i], ring[i + 1]) for ring in rings for i in range(1, len(ring) - 1)]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3), len(larger)


def _fan_log(larger: int) -> list[str]:
    return [f"{larger} faces with more than three corners were triangulated"] if larger else []


def _read_obj(file: Path) -> _Read:
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    text = _text(file).replace("\\\r\n", " ").replace("\\\n", " ")  # lines that are continued
    for line in text.splitlines():
        words = line.split("#")[0].split()
        if words[:1] == ["v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == ["f"]:
            corners = []
            for word in words[1:]:
                index = int(word.split("/")[0])
                if index == 0:
                    raise ValueError("a face names vertex 0, but OBJ counts from 1")
                # negative numbers count back from the vertices read so far
                corners.append(index - 1 if index > 0 else len(vertices) + index)
            polygons.append(corners)
    faces, larger = _fan(polygons)
    return np.array(vertices, dtype=np.float64).reshape(-1, 3), faces, _fan_log(larger)


def _read_off(file: Path) -> _Read:
    lines = [line.split("#")[0].split() for line in _text(file).splitlines()]
    rows = [row for row in lines if row]
    if not rows or "OFF" not in rows[0][0].upper():
        raise ValueError("no OFF header")
    rows = ([rows[0][1:]] if len(rows[0]) > 1 else []) + rows[1:]
    n_vertices, n_faces = int(rows[0][0]), int(rows[0][1])
    if min(n_vertices, n_faces) < 0:
        raise ValueError(f"{min(n_vertices, n_faces)} announced of what is counted")
    if len(rows) < 1 + n_vertices + n_faces:
        raise ValueError(
            f"{n_vertices} vertices and {n_faces} faces announced, {len(rows) - 1} lines found"
        )
    vertices = np.array([row[:3] for row in rows[1 : 1 + n_vertices]], dtype=np.float64)
    polygons = []
    for row in rows[1 + n_vertices : 1 + n_vertices + n_faces]:
        count = int(row[0])
        if len(row) < 1 + count:
            raise ValueError("a face line is cut short")
        polygons.append([int(word) for word in row[1 : 1 + count]])
    faces, larger = _fan(polygons)
    return vertices.reshape(-1, 3), faces, _fan_log(larger)


def _read_ply(file: Path) -> _Read:
    from plyfile import PlyData

    _check_ply_header(file)
    with file.open("rb") as stream:
        ply = PlyData.read(stream)
    elements = {element.name: element for element in ply.elements}
    if "vertex" not in elements:
        raise ValueError("no vertex element")
    data = elements["vertex"].data
    vertices = np.stack([np.asarray(data[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    if "face" in elements and len(elements["face"].data):
        face = elements["face"].data
        names = face.dtype.names or ()
        key = next((n for n in ("vertex_indices", "vertex_index") if n in names), None)
        if key is None:
            raise ValueError("the face element has no vertex_indices")
        faces, larger = _fan([list(map(int, row)) for row in face[key]])
        return vertices, faces, _fan_log(larger)
    if "tristrips" in elements and len(elements["tristrips"].data):
        strips = elements["tristrips"].data
        key = (strips.dtype.names or ("vertex_indices",))[0]
        faces = np.concatenate([strips_to_triangles(np.asarray(row)) for row in strips[key]])
        return vertices, faces, [f"{len(faces)} triangles were unrolled from triangle strips"]
    return vertices, np.zeros((0, 3), dtype=np.int64), []


def _check_ply_header(file: Path) -> None:
    """ValueError if the header announces more than the file can hold: room is made for it."""
    with file.open("rb") as stream:
        head = stream.read(_LONGEST_HEADER).partition(b"end_header")[0]
    size = file.stat().st_size
    for line in head.splitlines():
        words = line.split()
        if words[:1] == [b"element"] and len(words) == 3:
            if not 0 <= int(words[2]) <= size:
                raise ValueError(f"{int(words[2])} of an element in {size} bytes")


def strips_to_triangles(strip: np.ndarray) -> np.ndarray:
    """Triangles (F,3) of -1-separated strips (N,): every second triangle is turned round.

    Strips repeat vertices to restart without a separator; those empty triangles are left out.
    """
    strip = np.asarray(strip, dtype=np.int64)
    triangles = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    start = np.where(strip == -1, np.arange(len(strip)) + 1, 0)
    position = np.arange(len(strip)) - np.maximum.accumulate(start)  # place within its strip
    odd = position[: len(triangles)] % 2 == 1
    triangles[odd] = triangles[odd][:, [1, 0, 2]]
    a, b, c = triangles.T
    return triangles[(triangles >= 0).all(axis=1) & (a != b) & (b != c) & (c != a)]


def _read_trimesh(file: Path) -> _Read:
    import trimesh

    from nsm.surfaces.gltf import Beside, check_gltf

    kind = file.suffix.lower()[1:]
    if kind in ("gltf", "glb"):
        check_gltf(file)
    with file.open("rb") as stream:
        loaded = trimesh.load(
            stream, file_type=kind, process=False, resolver=Beside(file.parent), allow_remote=False
        )
    log: list[str] = []
    if isinstance(loaded, trimesh.Scene):
        meshes = [g for g in loaded.dump() if isinstance(g, trimesh.Trimesh)]
        if not meshes:
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), log
        if len(meshes) > 1:
            log.append(f"{len(meshes)} parts of the scene were put together")
        offsets = np.cumsum([0] + [len(m.vertices) for m in meshes])
        vertices = np.concatenate([np.asarray(m.vertices, dtype=np.float64) for m in meshes])
        faces = np.concatenate(
            [np.asarray(m.faces, dtype=np.int64) + o for m, o in zip(meshes, offsets, strict=False)]
        )
        return vertices, faces, log
    if not isinstance(loaded, trimesh.Trimesh):
        return np.zeros((1, 3)), np.zeros((0, 3), dtype=np.int64), log
    return (
        np.array(loaded.vertices, dtype=np.float64),
        np.array(loaded.faces, dtype=np.int64),
        log,
    )


def _text(file: Path) -> str:
    raw = file.read_bytes()
    if b"\0" in raw[:4096]:
        raise ValueError("binary data where text is expected")
    return raw.decode("utf-8-sig", errors="replace")
