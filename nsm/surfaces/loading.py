"""Read a mesh file into vertices and triangles, in the file's own vertex order.

The readers of OBJ and OFF are ours: general loaders split or reorder vertices at texture seams,
and users name landmarks by the vertex numbers of their file. PLY goes through plyfile (ascii,
binary, triangle strips); STL and glTF through trimesh.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.surfaces.obj import read_obj, text_of
from nsm.surfaces.recent import Recent, content
from nsm.wording import number_of

_LONGEST_HEADER = 100_000  # bytes
LARGEST_FILE = 4 * 2**30  # bytes
_READ = Recent()
EXTENSIONS = (".obj", ".ply", ".off", ".stl", ".gltf", ".glb")


def error_in(what: object, kind: str, reason: str) -> NsmError:
    """An error about a file or surface: its key, with which the message starts."""
    return NsmError(f"{what}: {reason}", kind=kind, key=str(what))


def is_mesh_path(text: str) -> bool:
    """Whether a word of the command line names a mesh file, rather than a catalogue entry.

    It does if such a file exists, or if it ends in one of EXTENSIONS. An existing file may contain
    ``=`` in its name; any other word with ``=`` is a setting.
    """
    if os.path.isfile(text):
        return True
    return "=" not in text and PurePath(text).suffix.lower() in EXTENSIONS


def is_number(word: str) -> bool:
    """Whether a word of a text file is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


@contextmanager
def parsing(file: Path, fault: str) -> Iterator[None]:
    """Turn what parsers raise on damaged files into an error on the file.

    Args:
        file: that is read.
        fault: begins the message, before what the parser says.

    Raises:
        NsmError: ``unreadable_file``.
    """
    try:
        yield
    except NsmError:
        raise
    except Exception as error:  # parsers raise any exception on damaged files
        cause = " ".join(str(error).split())[:150] or type(error).__name__
        raise error_in(file, "unreadable_file", f"{fault} ({cause}); export it again") from error


def check_file(file: Path, largest: int, endings: Sequence[str] = ()) -> None:
    """Check that a file is regular, has at most ``largest`` bytes and, if given, a known ending.

    Raises:
        NsmError: ``missing_file``, ``unreadable_file``, ``not_a_file``, ``unknown_format`` or
            ``file_too_large``. The key is the path.
    """
    try:
        status = file.stat()
    except FileNotFoundError:
        raise error_in(file, "missing_file", "no such file; check the path") from None
    except (OSError, ValueError) as error:  # too long, a loop of links, not allowed, a NUL in it
        reason = getattr(error, "strerror", None) or "not a path"
        raise error_in(file, "unreadable_file", f"{reason}; check the path") from error
    if not stat.S_ISREG(status.st_mode):  # reading a pipe blocks, reading a device never ends
        raise error_in(file, "not_a_file", "not a regular file; give a file")
    if endings and file.suffix.lower() not in endings:
        reason = f"unknown format '{file.suffix}'; use one of {', '.join(endings)}"
        raise error_in(file, "unknown_format", reason)
    if status.st_size > largest:
        raise error_in(file, "file_too_large", f"larger than {largest / 2**20:.0f} MB")


def load_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Read a mesh file; the latest that were read are remembered by their content.

    Returns:
        Vertices (V, 3) float64 in the order and units of the file, triangles (F, 3) int64, and one
        log line per conversion.

    Raises:
        NsmError: ``unreadable_file``, or as :func:`check_file` and :func:`check_arrays`. The key
            is the path.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    check_file(file, LARGEST_FILE, EXTENSIONS)
    # .gltf is left out: its arrays may be in files of their own
    if suffix == ".gltf" or file.stat().st_size > _READ.most_bytes:
        return _read(file, suffix)
    try:
        key = (str(file), content(file.read_bytes()))
    except OSError:
        return _read(file, suffix)  # which says what is wrong
    return _READ.get(key, lambda: _read(file, suffix))


def _read(file: Path, suffix: str) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    reader = {".obj": _read_obj, ".off": _read_off, ".ply": _read_ply}.get(suffix, _read_trimesh)
    with parsing(file, f"not a readable {suffix[1:].upper()} mesh"):
        vertices, faces, log = reader(file)
    check_arrays(vertices, faces, str(file))
    return vertices, faces, tuple(log)


def as_arrays(vertices: Any, faces: Any, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Convert vertices to float64 and faces to int64.

    Raises:
        NsmError: ``wrong_type``, vertices that are not real numbers or faces that are not integers.
    """
    try:
        vertices, given = np.asarray(vertices), np.asarray(faces)
        if vertices.dtype.kind not in "fiub" or given.dtype.kind not in "fiub":
            raise ValueError
        with np.errstate(invalid="ignore"):
            faces = given.astype(np.int64)
        if not np.array_equal(faces, given):
            raise ValueError
    except (TypeError, ValueError) as error:
        reason = "give vertices as real numbers (V, 3) and faces as integers (F, 3)"
        raise error_in(name, "wrong_type", reason) from error
    return vertices.astype(np.float64), faces


def check_arrays(vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    """Check that vertices are (V, 3) and finite and that faces are (F, 3) valid indices, F > 0.

    Raises:
        NsmError: ``wrong_shape``, ``not_a_mesh`` (no vertices or no faces), ``not_finite`` or
            ``out_of_range`` (a face with an unknown vertex). The key is the name.
    """
    for what, array in (("vertices", vertices), ("faces", faces)):
        if array.size and (array.ndim != 2 or array.shape[1] != 3):
            reason = f"{what} have the shape {array.shape}; give vertices and triangles (N, 3)"
            raise error_in(name, "wrong_shape", reason)
        if array.size == 0:
            raise error_in(name, "not_a_mesh", f"no {what}; give a triangle mesh")
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        reason = f"vertex {int(finite.argmin())} is NaN or infinite; repair it in a mesh editor"
        raise error_in(name, "not_finite", reason)
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = int(faces.max() if faces.min() >= 0 else faces.min())
        reason = f"a face uses vertex {wrong}, but there are {len(vertices)}; export it again"
        raise error_in(name, "out_of_range", reason)


_Read = tuple[np.ndarray, np.ndarray, list[str]]


def fans(polygons: Iterable[Sequence[int]]) -> tuple[np.ndarray, int]:
    """Polygons split into triangle fans.

    Args:
        polygons: the vertices of each, in order.

    Returns:
        Triangles (F, 3) int64, whose entries are positions in the list of all corners of all
        polygons; and how many polygons have more than three corners.

    Raises:
        ValueError: a polygon with fewer than three corners.
    """
    rings = [list(polygon) for polygon in polygons]
    if any(len(ring) < 3 for ring in rings):
        raise ValueError("a face has fewer than three corners")
    larger = [ring for ring in rings if len(ring) > 3]
    # Two quads may share two sides; the same diagonal in both would be a non-manifold edge, so a
    # quad whose diagonal exists is split along its other one.
    taken = set()
    if larger:
        taken = {frozenset(side) for r in rings for side in zip(r, r[1:] + r[:1], strict=True)}
    triangles, start = [], 0
    for ring in rings:
        corners = list(range(start, start + len(ring)))
        start += len(ring)
        if len(ring) > 3:
            if frozenset((ring[0], ring[2])) in taken:
                ring.append(ring.pop(0))
                corners.append(corners.pop(0))
            taken.update(frozenset((ring[0], corner)) for corner in ring[2:-1])
        triangles += [(corners[0], *corners[i : i + 2]) for i in range(1, len(ring) - 1)]
    return np.array(triangles, dtype=np.int64).reshape(-1, 3), len(larger)


def _triangulated(vertices: Any, polygons: Sequence[Sequence[int]]) -> _Read:
    """Vertices (V, 3), and polygons split into triangle fans."""
    corners, larger = fans(polygons)
    flat = np.array([corner for polygon in polygons for corner in polygon], dtype=np.int64)
    return (
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        flat[corners],
        [f"{number_of(larger, 'polygon')} triangulated"] if larger else [],
    )


def _read_obj(file: Path) -> _Read:
    obj = read_obj(file)
    return _triangulated(obj.vertices, obj.polygons)


def _read_off(file: Path) -> _Read:
    lines = [line.split("#")[0].split() for line in text_of(file).splitlines()]
    rows = [row for row in lines if row]
    if not rows or "OFF" not in rows[0][0].upper():
        raise ValueError("no OFF header")
    rows = ([rows[0][1:]] if len(rows[0]) > 1 else []) + rows[1:]
    n_vertices, n_faces = int(rows[0][0]), int(rows[0][1])
    if min(n_vertices, n_faces) < 0:
        raise ValueError("the header has a negative count")
    if len(rows) < 1 + n_vertices + n_faces:
        raise ValueError(
            f"the header announces {number_of(n_vertices, 'vertex')} and "
            f"{number_of(n_faces, 'face')}; after it: {number_of(len(rows) - 1, 'line')}"
        )
    vertices = [[float(x) for x in row[:3]] for row in rows[1 : 1 + n_vertices]]
    polygons = []
    for row in rows[1 + n_vertices : 1 + n_vertices + n_faces]:
        count = int(row[0])
        if len(row) < 1 + count:
            raise ValueError("a face line is too short")
        polygons.append([int(index) for index in row[1 : 1 + count]])
    return _triangulated(vertices, polygons)


def read_ply(file: Path) -> tuple[dict[str, Any], list[str]]:
    """The elements of a PLY file by name, each an array with named columns; and its comments.

    Raises:
        ValueError: it is damaged.
    """
    from plyfile import PlyData

    _check_ply_header(file)
    with file.open("rb") as stream:
        ply = PlyData.read(stream)
    return {element.name: element.data for element in ply.elements}, list(ply.comments)


def ply_polygons(face: Any) -> list[list[int]]:
    """The vertices of each polygon of a PLY file's element ``face``.

    Raises:
        ValueError: it has none.
    """
    names = face.dtype.names or ()
    key = next((n for n in ("vertex_indices", "vertex_index") if n in names), None)
    if key is None:
        raise ValueError("the face element has no vertex_indices")
    return [list(map(int, row)) for row in face[key]]


def _read_ply(file: Path) -> _Read:
    elements, _ = read_ply(file)
    if "vertex" not in elements:
        raise ValueError("no vertex element")
    data = elements["vertex"]
    vertices = np.stack([np.asarray(data[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    if len(elements.get("face", ())):
        return _triangulated(vertices, ply_polygons(elements["face"]))
    if len(elements.get("tristrips", ())):
        strips = elements["tristrips"]
        key = (strips.dtype.names or ("vertex_indices",))[0]
        faces = np.concatenate([_strip_triangles(np.asarray(row)) for row in strips[key]])
        line = f"triangle strips converted to {number_of(len(faces), 'triangle')}"
        return vertices, faces, [line]
    return vertices, np.zeros((0, 3), dtype=np.int64), []


def _check_ply_header(file: Path) -> None:
    """ValueError if the header announces more than the file can hold: plyfile allocates it."""
    with file.open("rb") as stream:
        head = stream.read(_LONGEST_HEADER).partition(b"end_header")[0]
    size = file.stat().st_size
    for line in head.splitlines():
        fields = line.split()
        if fields[:1] == [b"element"] and len(fields) == 3:
            if not 0 <= int(fields[2]) <= size:
                raise ValueError(
                    f"the header announces {int(fields[2])} elements in a file of {size} bytes"
                )


def _strip_triangles(strip: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) of strips (N,) separated by -1; every second one is reversed.

    Strips repeat vertices to restart without a separator; the degenerate triangles of a restart
    are left out.
    """
    strip = np.asarray(strip, dtype=np.int64)
    triangles = np.stack([strip[:-2], strip[1:-1], strip[2:]], axis=1)
    start = np.where(strip == -1, np.arange(len(strip)) + 1, 0)
    position = np.arange(len(strip)) - np.maximum.accumulate(start)  # within its strip
    odd = position[: len(triangles)] % 2 == 1
    triangles[odd] = triangles[odd][:, [1, 0, 2]]
    a, b, c = triangles.T
    return triangles[(triangles >= 0).all(axis=1) & (a != b) & (b != c) & (c != a)]


def read_scene(file: Path) -> list[Any]:
    """The triangle meshes of an STL, glTF or GLB file, in their places, as trimesh has them.

    Raises:
        ValueError: it is damaged, or has no triangles.
    """
    import trimesh

    from nsm.surfaces.folder_resolver import FolderResolver
    from nsm.surfaces.gltf import check_gltf

    kind = file.suffix.lower()[1:]
    if kind in ("gltf", "glb"):
        check_gltf(file)
    with file.open("rb") as stream:
        loaded = trimesh.load(
            stream,
            file_type=kind,
            process=False,
            resolver=FolderResolver(file.parent),
            allow_remote=False,
        )
    parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
    meshes = [part for part in parts if isinstance(part, trimesh.Trimesh)]
    if not meshes:
        raise ValueError("no triangles")
    return meshes


def _read_trimesh(file: Path) -> _Read:
    meshes = read_scene(file)
    log = [f"{len(meshes)} meshes of the scene combined"] if len(meshes) > 1 else []
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    vertices = np.concatenate([np.asarray(m.vertices, dtype=np.float64) for m in meshes])
    faces = np.concatenate(
        [np.asarray(m.faces, dtype=np.int64) + o for m, o in zip(meshes, offsets, strict=True)]
    )
    return vertices, faces, log
