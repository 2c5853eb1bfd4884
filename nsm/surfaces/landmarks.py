"""Landmarks: corresponding points of surfaces, as vertices of the meshes.

A landmark is a vertex number, a point [x, y, z], or a place [triangle, b0, b1, b2] with barycentric
coordinates. Maps take landmarks at vertices: of a point the nearest one; a place becomes a vertex
where a mesh is prepared for the map, and is the nearest one elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from nsm.surfaces.loading import error_in
from nsm.surfaces.location import Places
from nsm.surfaces.validation import CleanMesh

# vertices, MISSING for none; or points (L, 3) or places (L, 4), rows of NaN for none
Landmarks = list[int] | np.ndarray
MISSING = -1
_SUM = 1e-3  # how far from one barycentric coordinates may add up, and below zero lie
_FAR = 0.05  # of the bounding box's diagonal: a point farther from the mesh is a mistake


class AtVertices(NamedTuple):
    """Landmarks moved to vertices (L,), and how far each was moved (L,), in the mesh's unit; a
    landmark that the mesh lacks is :data:`MISSING`."""

    vertex: np.ndarray
    moved: np.ndarray


def as_vertices(
    landmarks: Sequence[Any] | np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray | None,
    name: str,
) -> AtVertices:
    """Landmarks as distinct vertices of a mesh.

    Args:
        landmarks: vertex numbers; or points (L, 3), each of which becomes the nearest vertex; or
            places (L, 4), each of which becomes the nearest corner of its triangle; None or -1
            among them for landmarks that the mesh lacks.
        vertices: (V, 3), in the unit of the points.
        faces: (F, 3), in the order of the mesh file; None if that is not known.
        name: of the surface, the key of errors.

    Raises:
        NsmError: ``out_of_range``, ``not_on_surface`` (a point far from the mesh, or one outside
            its triangle), ``duplicate_landmark`` or ``wrong_type``.
    """
    given = listed(landmarks, name)
    there = present(given)
    if not isinstance(given, np.ndarray):
        for k in np.flatnonzero(there).tolist():
            if not 0 <= given[k] < len(vertices):
                reason = (
                    f"landmark {k} is vertex {given[k]}; give vertices 0 to {len(vertices) - 1}"
                )
                raise error_in(name, "out_of_range", reason)
        found = AtVertices(np.array(given, dtype=np.int64), np.zeros(len(given)))
    else:
        numbers = np.flatnonzero(there)
        nearest = _nearest_vertices if given.shape[1] == 3 else _nearest_corners
        some = nearest(given[there], numbers, vertices, faces, name)
        found = AtVertices(np.full(len(given), MISSING), np.zeros(len(given)))
        found.vertex[there], found.moved[there] = some
    seen: dict[int, int] = {}
    for k, vertex in enumerate(found.vertex.tolist()):
        if vertex in seen and vertex != MISSING:
            reason = f"landmarks {seen[vertex]} and {k} are both vertex {vertex}; leave one out"
            raise error_in(name, "duplicate_landmark", reason)
        seen[vertex] = k
    return found


def kept_landmarks(mesh: CleanMesh, landmarks: np.ndarray, name: str) -> np.ndarray:
    """Landmarks, vertices (L,) of a mesh file, as vertices of the cleaned mesh; -1 for none.

    Raises:
        NsmError: ``not_on_surface``: one is not on the part that is kept; ``duplicate_landmark``:
            the vertices of two are one vertex of the cleaned mesh.
    """
    kept = np.where(landmarks >= 0, mesh.merged[landmarks], MISSING)
    seen: dict[int, int] = {}
    for k, (given, vertex) in enumerate(zip(landmarks.tolist(), kept.tolist(), strict=True)):
        if given >= 0 and vertex < 0:
            reason = f"landmark {k}, vertex {given}, is not on the part that is kept; give another"
            raise error_in(name, "not_on_surface", reason)
        if vertex in seen and vertex != MISSING:
            first = seen[vertex]
            both = f"landmarks {first} and {k}, vertices {landmarks[first]} and {given}"
            reason = f"{both}, are duplicates of one vertex; leave one out"
            raise error_in(name, "duplicate_landmark", reason)
        seen[vertex] = k
    return kept


def present(landmarks: Landmarks) -> np.ndarray:
    """Mask (L,) of the landmarks that a surface has."""
    if isinstance(landmarks, np.ndarray) and landmarks.ndim == 2:
        return np.asarray(np.isfinite(landmarks).all(axis=1))
    return np.asarray(landmarks, dtype=np.int64) != MISSING


def _nearest_vertices(
    given: np.ndarray,
    numbers: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray | None,
    name: str,
) -> AtVertices:
    distance, nearest = cKDTree(vertices).query(given)
    limit = _FAR * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    for k in np.flatnonzero(distance > limit)[:1].tolist():
        what = f"landmark {numbers[k]} at {given[k].tolist()}"
        where = f"{what} is {distance[k]:.3g} away from the mesh"
        reason = f"{where}; give points on the mesh, in the units of its file"
        raise error_in(name, "not_on_surface", reason)
    return AtVertices(nearest.astype(np.int64), distance)


def _nearest_corners(
    given: np.ndarray,
    numbers: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray | None,
    name: str,
) -> AtVertices:
    if faces is None:
        reason = "the triangles of its file are not known here; give vertices, or the mesh file"
        raise error_in(name, "wrong_type", reason)
    check_places(given, faces, name, numbers)
    at = Places(given[:, 0].astype(np.int64), given[:, 1:]).take(vertices, faces)
    corners = faces[given[:, 0].astype(np.int64)]
    distance = np.linalg.norm(vertices[corners] - at[:, None], axis=2)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(given))
    return AtVertices(corners[rows, nearest].astype(np.int64), distance[rows, nearest])


def check_places(given: np.ndarray, faces: np.ndarray, name: str, numbers: np.ndarray) -> None:
    """Check that places (L, 4) are on triangles (F, 3).

    Args:
        given: the places.
        faces: of the mesh.
        name: of the surface, the key of errors.
        numbers: (L,) which landmark each is.

    Raises:
        NsmError: ``out_of_range``: no such triangle; ``not_on_surface``: outside its triangle.
    """
    for k, (face, *weights) in zip(numbers.tolist(), given.tolist(), strict=True):
        if not 0 <= face < len(faces) or not face.is_integer():
            reason = f"landmark {k} is in triangle {face:g}; give triangles 0 to {len(faces) - 1}"
            raise error_in(name, "out_of_range", reason)
        if abs(sum(weights) - 1) > _SUM or min(weights) < -_SUM:
            reason = f"landmark {k} has the coordinates {weights}; they are positive, with sum 1"
            raise error_in(name, "not_on_surface", reason)


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
    """Landmarks as a list of vertex numbers, or as points (L, 3), or as places (L, 4).

    Args:
        given: a list, array or tensor; None, -1 or a row of NaN in it for a landmark that the
            surface lacks.
        what: what it is, the key of errors.

    Raises:
        NsmError: ``wrong_type``.
    """
    given = as_lists(given)
    if not isinstance(given, list):
        raise error_in(what, "wrong_type", "give a list of landmarks")
    if all(x is None or _is_number(x) for x in given):
        for k, x in enumerate(given):
            # np.loadtxt returns integers as floats
            if x is not None and not float(x).is_integer():
                reason = f"landmark {k} is {x}; vertex numbers are whole, points [x, y, z]"
                raise error_in(what, "wrong_type", reason)
        return [MISSING if x is None else int(x) for x in given]
    there = [not _is_missing(x) for x in given]
    try:
        some = np.array([x for x, has in zip(given, there, strict=True) if has], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        some = np.zeros(0)
    if some.ndim != 2 or some.shape[1] not in (3, 4) or not np.isfinite(some).all():
        reason = (
            "give landmarks all as vertex numbers, all as points [x, y, z], or all as places "
            "[triangle, b0, b1, b2]"
        )
        raise error_in(what, "wrong_type", reason)
    points = np.full((len(given), some.shape[1]), np.nan)
    points[there] = some
    return points


def _is_missing(x: Any) -> bool:
    if isinstance(x, list):
        return len(x) > 0 and all(_is_number(c) and c != c for c in x)
    return x is None or (_is_number(x) and x == MISSING)


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool)
