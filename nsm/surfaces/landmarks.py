"""Landmarks: corresponding points of surfaces, from files or lists, as vertices of the meshes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from nsm.surfaces.loading import check_file, error_in

Landmarks = list[int] | np.ndarray
_ENDINGS = (".vts", ".txt", ".pinned", ".json")
_LARGEST = 10_000_000  # bytes
_FAR = 0.05  # of the bounding box's diagonal: a point farther from the mesh is a mistake


def read_landmarks(path: str | Path) -> Landmarks:
    """The landmarks of one surface: vertex numbers, or points (L, 3).

    Each line of ``.vts``, ``.txt`` and ``.pinned`` starts with one vertex number; ``.json`` is a
    list of numbers, or of points [x, y, z].

    Raises:
        NsmError: ``no_landmarks``, ``damaged_file``, ``wrong_type``, or as
            :func:`nsm.surfaces.loading.check_file`. The key is the path.
    """
    file = Path(path)
    if file.suffix.lower() == ".json":
        return listed(_json(file), str(file))
    result = []
    for number, line in enumerate(_text(file, _ENDINGS).splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            result.append(int(fields[0]))
        except ValueError:
            reason = f"line {number} does not start with a vertex number"
            raise error_in(file, "damaged_file", reason) from None
    if not result:
        raise error_in(file, "no_landmarks", "no landmarks; give one vertex number per line")
    return result


def read_pairs(path: str | Path) -> tuple[Landmarks, Landmarks]:
    """The landmarks of source and target from a JSON file.

    The file has {"source": [...], "target": [...]}, or {"pairs": [[i, j], ...]}, or only the list
    of pairs. Each landmark is a vertex number or a point [x, y, z].

    Raises:
        NsmError: as :func:`read_landmarks`.
    """
    file = Path(path)
    content = _json(file)
    if isinstance(content, dict) and {"source", "target"} <= set(content):
        source, target = (listed(content[end], f"{file}, {end}") for end in ("source", "target"))
        return source, target
    pairs = content.get("pairs") if isinstance(content, dict) else content
    if not isinstance(pairs, list) or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
        reason = 'give {"source": [...], "target": [...]} or a list of pairs'
        raise error_in(file, "wrong_type", reason)
    return listed([p[0] for p in pairs], str(file)), listed([p[1] for p in pairs], str(file))


def read_collection(path: str | Path) -> list[Landmarks]:
    """The landmarks of several surfaces from a JSON file.

    The file has {"landmarks": [[...], ...]}, or only the lists, one per surface.

    Raises:
        NsmError: as :func:`read_landmarks`.
    """
    file = Path(path)
    content = _json(file)
    lists = content.get("landmarks") if isinstance(content, dict) else content
    if not isinstance(lists, list):
        raise error_in(file, "wrong_type", "give a list of landmarks for each surface")
    return [listed(item, f"{file}, list {k}") for k, item in enumerate(lists)]


def as_vertices(
    landmarks: Sequence[Any] | np.ndarray, vertices: np.ndarray, name: str
) -> np.ndarray:
    """Landmarks as distinct vertices (L,) of a mesh.

    Args:
        landmarks: vertex numbers, or points (L, 3), each of which becomes the nearest vertex.
        vertices: (V, 3), in the unit of the points.
        name: of the surface, the key of errors.

    Raises:
        NsmError: ``out_of_range``, ``not_on_surface`` (a point far from the mesh),
            ``duplicate_landmark`` or ``wrong_type``.
    """
    given = listed(landmarks, name)
    if isinstance(given, np.ndarray):
        distance, nearest = cKDTree(vertices).query(given)
        limit = _FAR * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        for k in np.flatnonzero(distance > limit)[:1].tolist():
            where = f"landmark {k} at {given[k].tolist()} is {distance[k]:.3g} away from the mesh"
            reason = f"{where}; give points on the mesh, in the units of its file"
            raise error_in(name, "not_on_surface", reason)
        ids = nearest.astype(np.int64)
    else:
        for k, vertex in enumerate(given):
            if not 0 <= vertex < len(vertices):
                reason = f"landmark {k} is vertex {vertex}; give vertices 0 to {len(vertices) - 1}"
                raise error_in(name, "out_of_range", reason)
        ids = np.array(given, dtype=np.int64)
    seen: dict[int, int] = {}
    for k, vertex in enumerate(ids.tolist()):
        if vertex in seen:
            reason = f"landmarks {seen[vertex]} and {k} are both vertex {vertex}; leave one out"
            raise error_in(name, "duplicate_landmark", reason)
        seen[vertex] = k
    return ids


def check_equal_lengths(names: Sequence[str], lists: Sequence[Landmarks]) -> None:
    """Check that all surfaces have the same number of landmarks.

    Raises:
        NsmError: ``different_lengths``, with the key ``landmarks``.
    """
    counts = [len(item) for item in lists]
    if len(set(counts)) > 1:
        listing = ", ".join(f"{n} has {count}" for n, count in zip(names, counts, strict=True))
        reason = f"{listing}; give the same landmarks on each surface, in the same order"
        raise error_in("landmarks", "different_lengths", reason)


def as_lists(given: Any) -> Any:
    """Arrays and tensors as lists, nested ones too; anything else unchanged."""
    if hasattr(given, "tolist"):
        return given.tolist()
    if isinstance(given, Sequence) and not isinstance(given, (str, bytes)):
        return [as_lists(item) for item in given]
    return given


def listed(given: Any, what: str) -> Landmarks:
    """Landmarks as a list of vertex numbers, or as points (L, 3).

    Args:
        given: a list, array or tensor.
        what: what it is, the key of errors.

    Raises:
        NsmError: ``wrong_type``.
    """
    given = as_lists(given)
    if not isinstance(given, list):
        raise error_in(what, "wrong_type", "give a list of landmarks")
    if all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in given):
        for k, x in enumerate(given):
            if not float(x).is_integer():  # np.loadtxt returns integers as floats
                reason = f"landmark {k} is {x}; vertex numbers are whole, points [x, y, z]"
                raise error_in(what, "wrong_type", reason)
        return [int(x) for x in given]
    try:
        points = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        reason = "give landmarks either all as vertex numbers or all as points [x, y, z]"
        raise error_in(what, "wrong_type", reason)
    return points


def _json(file: Path) -> Any:
    try:
        return json.loads(_text(file))
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:80]
        raise error_in(file, "damaged_file", f"not readable as JSON ({reason})") from error


def _text(file: Path, endings: Sequence[str] = ()) -> str:
    check_file(file, _LARGEST, endings)
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise error_in(file, "damaged_file", "not a text file") from error
    except OSError as error:
        raise error_in(file, "unreadable_file", error.strerror or "cannot be read") from error
