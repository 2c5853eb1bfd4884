"""Remove degenerate and duplicate triangles of a mesh, without leaving holes."""

from __future__ import annotations

import numpy as np

from nsm.surfaces import topology
from nsm.surfaces.loading import error_in
from nsm.wording import number_of

# A triangle is degenerate if its height over its longest side is below twice this share of the
# bounding box's diagonal, about the precision of its coordinates. Small triangles are not.
DEGENERATE_HEIGHT = 1e-14


def without_degenerate(
    vertices: np.ndarray, faces: np.ndarray, name: str, log: list[str]
) -> np.ndarray:
    """The faces without degenerate and duplicate ones."""
    diagonal = float(np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0)))
    limit = DEGENERATE_HEIGHT * diagonal
    distinct = distinct_corners(faces)
    if not distinct.all():
        log.append(f"{number_of(int((~distinct).sum()), 'face')} with a repeated vertex removed")
    faces = faces[distinct]
    degenerate = _is_degenerate(vertices, faces, limit)
    if degenerate.all():
        raise error_in(name, "degenerate", "all triangles are degenerate; give another mesh")
    if degenerate.any():
        # removing a degenerate triangle inside would leave a hole: only an edge flip keeps the
        # surface closed
        before = topology.euler_characteristic(faces[first_uses(faces)])
        faces, flipped, removed = _flip_degenerate(vertices, faces, degenerate, limit)
        kept = faces[first_uses(faces)]
        if len(kept) == 0 or topology.euler_characteristic(kept) != before:
            where = f"removing {number_of(removed, 'degenerate triangle')} would leave holes"
            reason = f"{where}; merge vertices by distance in a mesh editor"
            raise error_in(name, "degenerate", reason)
        if flipped:
            log.append(f"{number_of(flipped, 'degenerate triangle')} removed by edge flips")
        if removed:
            log.append(f"{number_of(removed, 'degenerate triangle')} removed")
    first = first_uses(faces)
    if not first.all():
        log.append(f"{number_of(int((~first).sum()), 'duplicate face')} removed")
    return faces[first]


def distinct_corners(faces: np.ndarray) -> np.ndarray:
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


def first_uses(faces: np.ndarray) -> np.ndarray:
    """Mask (F,) of the faces that do not have the same three vertices as an earlier face."""
    first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]
    mask = np.zeros(len(faces), dtype=bool)
    mask[first] = True
    return mask


def _is_degenerate(vertices: np.ndarray, faces: np.ndarray, limit: float) -> np.ndarray:
    """Mask (F,) of the faces whose height over their longest side is below twice the limit."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    return topology.face_areas(vertices, faces) <= limit * longest


def _flip_degenerate(
    vertices: np.ndarray, faces: np.ndarray, degenerate: np.ndarray, limit: float
) -> tuple[np.ndarray, int, int]:
    """Flip the longest edge of each degenerate face (mask (F,)), or remove the face.

    A degenerate face between others may become flippable once its neighbour is, so the passes
    repeat until nothing changes.

    Returns:
        The faces (G, 3), how many were flipped and how many removed.
    """
    faces = faces.copy()
    faces_at: dict[tuple[int, int], set[int]] = {}
    for f, face in enumerate(faces.tolist()):
        for edge in _sides(face):
            faces_at.setdefault(edge, set()).add(f)
    left = np.flatnonzero(degenerate).tolist()
    flipped, changed = 0, True
    while changed:
        changed = False
        for f in list(left):
            g = _flip(vertices, faces, faces_at, f, limit)
            if g is not None:
                left = [h for h in left if h not in (f, g)]
                flipped += 1
                changed = True
    return np.delete(faces, left, axis=0), flipped, len(left)


def _flip(
    vertices: np.ndarray,
    faces: np.ndarray,
    faces_at: dict[tuple[int, int], set[int]],
    f: int,
    limit: float,
) -> int | None:
    """Flip the longest edge of face f in place; the other face, or None if it cannot be flipped.

    Both new faces must have an area, and the new edge must not exist yet.
    """
    a, b, c = faces[f].tolist()
    p, q, r = max(
        [(a, b, c), (b, c, a), (c, a, b)],
        key=lambda side: float(np.linalg.norm(vertices[side[0]] - vertices[side[1]])),
    )
    beyond = faces_at[min(p, q), max(p, q)] - {f}
    if len(beyond) != 1:
        return None
    g = beyond.pop()
    s = next(v for v in faces[g].tolist() if v not in (p, q))
    if s == r or faces_at.get((min(r, s), max(r, s))):
        return None
    pair = np.array([(r, p, s), (r, s, q)], dtype=np.int64)
    if _is_degenerate(vertices, pair, limit).any():
        return None
    for h, new in zip((f, g), pair, strict=True):
        for edge in _sides(faces[h].tolist()):
            faces_at[edge].discard(h)
        faces[h] = new
    for h in (f, g):
        for edge in _sides(faces[h].tolist()):
            faces_at.setdefault(edge, set()).add(h)
    return g


def _sides(face: list[int]) -> list[tuple[int, int]]:
    a, b, c = face
    return [(min(a, b), max(a, b)), (min(b, c), max(b, c)), (min(c, a), max(c, a))]
