"""Landmarks: points of surfaces that correspond, from files or lists, as vertices of the meshes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from nsm.errors import NsmError

Landmarks = list[int] | np.ndarray
_ENDINGS = (".vts", ".txt", ".pinned", ".json")
_LARGEST = 10_000_000  # bytes
_FAR = 0.05  # of the bounding box's diagonal: a point so far off the mesh is a mistake


def read_landmarks(path: str | Path) -> Landmarks:
    """One surface's landmarks: vertex numbers, or points (L, 3).

    ``.vts``, ``.txt`` and ``.pinned`` have one vertex number at the start of each line; ``.json``
    is a list of numbers, or of points [x, y, z].

    Raises:
        NsmError: a file that cannot be read as such.
    """
    file = Path(path)
    if file.suffix.lower() not in _ENDINGS:
        raise NsmError(f"{file}: landmarks are read from {', '.join(_ENDINGS)} files")
    if file.suffix.lower() == ".json":
        return listed(_json(file), str(file))
    result = []
    for number, line in enumerate(_text(file).splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            result.append(int(words[0]))
        except ValueError:
            raise NsmError(
                f"{file}: line {number} does not start with a vertex number; "
                "give one landmark a line"
            ) from None
    if not result:
        raise NsmError(f"{file}: no landmarks in it; give one vertex number a line")
    return result


def read_pairs(path: str | Path) -> tuple[Landmarks, Landmarks]:
    """Landmarks of source and target from a JSON file.

    It is {"source": [...], "target": [...]}, or {"pairs": [[i, j], ...]}, or the pairs alone; each
    landmark is a vertex number or a point [x, y, z].

    Raises:
        NsmError: a file that cannot be read as such.
    """
    file = Path(path)
    words = _json(file)
    if isinstance(words, dict) and {"source", "target"} <= set(words):
        return listed(words["source"], f"{file}, source"), listed(
            words["target"], f"{file}, target"
        )
    pairs = words.get("pairs") if isinstance(words, dict) else words
    if not isinstance(pairs, list) or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
        raise NsmError(
            f'{file}: neither {{"source": [...], "target": [...]}} nor a list of pairs; '
            "give one of these"
        )
    return listed([p[0] for p in pairs], str(file)), listed([p[1] for p in pairs], str(file))


def read_collection(path: str | Path) -> list[Landmarks]:
    """Landmarks of several surfaces from a JSON file: {"landmarks": [[...], ...]} or the lists.

    Raises:
        NsmError: a file that cannot be read as such.
    """
    file = Path(path)
    words = _json(file)
    lists = words.get("landmarks") if isinstance(words, dict) else words
    if not isinstance(lists, list):
        raise NsmError(f"{file}: not a list of lists of landmarks; give one for each surface")
    return [listed(item, f"{file}, list {k}") for k, item in enumerate(lists)]


def as_vertices(
    landmarks: Sequence[Any] | np.ndarray, vertices: np.ndarray, name: str
) -> np.ndarray:
    """Landmarks, given as vertex numbers or points (L, 3), as different vertices (L,) of a mesh.

    A point stands for the nearest vertex of vertices (V, 3).

    Raises:
        NsmError: a number out of range, a point far from the mesh, or a landmark given twice.
    """
    given = listed(landmarks, name)
    if isinstance(given, np.ndarray):
        distance, nearest = cKDTree(vertices).query(given)
        limit = _FAR * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        for k in np.flatnonzero(distance > limit)[:1].tolist():
            raise NsmError(
                f"{name}: landmark {k} at {given[k].tolist()} is {distance[k]:.3g} away from the "
                "mesh; give a point on it, in the units of its file"
            )
        ids = nearest.astype(np.int64)
    else:
        for k, vertex in enumerate(given):
            if not 0 <= vertex < len(vertices):
                raise NsmError(
                    f"{name}: landmark {k} is vertex {vertex}, but the mesh has vertices 0 to "
                    f"{len(vertices) - 1}; give one of these"
                )
        ids = np.array(given, dtype=np.int64)
    seen: dict[int, int] = {}
    for k, vertex in enumerate(ids.tolist()):
        if vertex in seen:
            raise NsmError(
                f"{name}: landmarks {seen[vertex]} and {k} are both vertex {vertex}; "
                "leave one of them out"
            )
        seen[vertex] = k
    return ids


def check_equal_lengths(names: Sequence[str], lists: Sequence[Landmarks]) -> None:
    """NsmError unless all surfaces have as many landmarks."""
    counts = [len(item) for item in lists]
    if len(set(counts)) > 1:
        told = ", ".join(f"{name} has {count}" for name, count in zip(names, counts, strict=True))
        raise NsmError(f"landmarks: {told}; give each surface the same ones, in the same order")


def as_lists(given: Any) -> Any:
    """Arrays and tensors as lists, those within lists too; anything else as it is."""
    if hasattr(given, "tolist"):
        return given.tolist()
    if isinstance(given, Sequence) and not isinstance(given, (str, bytes)):
        return [as_lists(item) for item in given]
    return given


def listed(given: Any, what: str) -> Landmarks:
    """Landmarks as a list of vertex numbers, or as points (L, 3).

    Raises:
        NsmError: anything else.
    """
    given = as_lists(given)
    if not isinstance(given, list):
        raise NsmError(f"{what}: not a list of landmarks")
    if all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in given):
        for k, x in enumerate(given):
            if not float(x).is_integer():  # np.loadtxt gives whole numbers as floats
                raise NsmError(
                    f"{what}: landmark {k} is {x}; vertex numbers are whole, points [x, y, z]"
                )
        return [int(x) for x in given]
    try:
        points = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise NsmError(f"{what}: landmarks are all vertex numbers or all points [x, y, z]")
    return points


def _json(file: Path) -> Any:
    try:
        return json.loads(_text(file))
    except (ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:80]
        raise NsmError(f"{file}: not readable as JSON ({reason})") from error


def _text(file: Path) -> str:
    try:
        if file.exists() and not file.is_file():  # a pipe would be waited for
            raise NsmError(f"{file}: not a regular file; give a list of landmarks")
        if file.stat().st_size > _LARGEST:
            raise NsmError(f"{file}: larger than {_LARGEST // 1_000_000} MB; not a landmark list")
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise NsmError(f"{file}: {error.strerror or 'cannot be read'}") from error
    except UnicodeDecodeError as error:
        raise NsmError(f"{file}: not a text file") from error
