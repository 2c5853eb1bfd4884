"""Make a mesh a clean oriented manifold, or say in one line why that is not possible.

Only repairs that cannot change the shape are made, and each is logged; anything that needs a
decision (several parts, edges with three faces, one-sided surfaces) is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.loading import as_arrays, check_arrays

# Loose parts below these shares of the area (each, and together) are debris or trimmings, such as
# eyeballs behind a face, and are dropped; above, which part is meant is the user's to say.
DROPPED_SHARE = 0.05
DROPPED_TOTAL = 0.10
# A face is collapsed if its height over its longest side is below twice this share of the bounding
# box's diagonal, about what the digits of its coordinates can tell. A small face is none for that.
DEGENERATE_HEIGHT = 1e-14
# Neighbours this close, in shares of the diagonal, are one vertex written down twice.
COINCIDENT = 1e-13
# Of coordinates and of the bounding box, in the file's unit: results are written in single
# precision too, which holds no more.
LARGEST, SMALLEST = 1e30, 1e-30


@dataclass(frozen=True)
class CleanMesh:
    """An oriented, connected manifold mesh.

    vertices (V,3), faces (F,3), source_vertex (V,) index into the mesh as given; merged (W,) for
    each given vertex its vertex here, or -1 if it is gone; log, one line per repair.
    """

    vertices: np.ndarray
    faces: np.ndarray
    source_vertex: np.ndarray
    merged: np.ndarray
    log: tuple[str, ...]


def clean(vertices: np.ndarray, faces: np.ndarray, name: str = "mesh") -> CleanMesh:
    """Repair what can be repaired without changing the shape; NsmError for the rest."""
    vertices, faces = as_arrays(vertices, faces, name)
    check_arrays(vertices, faces, name)
    _check_size(vertices, faces, name)
    log: list[str] = []
    count = len(vertices)

    representative = _merge_coincident(vertices, faces, log)
    representative = _merge_near(vertices, representative, faces, log)
    unreferenced = len(np.setdiff1d(representative, representative[faces]))
    if unreferenced:
        log.append(f"{unreferenced} unreferenced vertices removed")
    faces = _drop_bad_faces(vertices, representative[faces], name, log)
    edges = topology.edges_of(faces)
    if edges.count.max() > 2:
        where = edges.pairs[int(edges.count.argmax())]
        raise NsmError(
            f"{name}: {int((edges.count > 2).sum())} non-manifold edges (more than two faces, "
            f"e.g. at vertices {where[0]}-{where[1]}); remove inner faces in a mesh editor"
        )
    faces = _keep_main_part(vertices, faces, name, log)
    faces = _orient(faces, name, log)

    split_faces, old = topology.cut_along(
        faces, np.zeros(len(topology.edges_of(faces).pairs), dtype=bool)
    )
    used = len(np.unique(faces))
    if len(old) > used:
        log.append(f"{len(old) - used} copies made of vertices where faces only touch at a point")
        # parts that hung together only by such a point are separate now
        split_faces = _keep_main_part(vertices[old], split_faces, name, log)
        kept = np.unique(split_faces)
        split_faces = np.searchsorted(kept, split_faces)
        old = old[kept]
    index = np.full(count, -1, dtype=np.int64)
    index[old[::-1]] = np.arange(len(old))[::-1]  # the first copy wins
    return CleanMesh(vertices[old], split_faces, old, index[representative], tuple(log))


def _check_size(vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    used = vertices[np.unique(faces)]
    largest = float(np.abs(used).max())
    if largest > LARGEST or 0 < np.ptp(used, axis=0).max() < SMALLEST:
        raise NsmError(
            f"{name}: too {'large' if largest > LARGEST else 'small'} for single precision "
            f"(coordinates up to {largest:.3g}); scale the mesh"
        )


def _merge_coincident(vertices: np.ndarray, faces: np.ndarray, log: list[str]) -> np.ndarray:
    """For each vertex (V,) the first vertex at exactly its place, or itself where none is merged.

    Nothing is merged if that would tie edges to three faces which have two as they are; but
    triangles that share no vertices at all (STL) are joined whatever comes of it.
    """
    keep = np.arange(len(vertices))
    _, first, inverse = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    representative = first[inverse.ravel()]
    duplicates = len(vertices) - len(first)
    if duplicates == 0:
        return keep
    soup = len(faces) > 1 and len(np.unique(faces)) == faces.size
    if not soup and _most_faces_at_an_edge(representative[faces]) > 2 >= _most_faces_at_an_edge(
        faces
    ):
        log.append(
            f"{duplicates} coincident vertices left apart: joined, edges would have three faces"
        )
        return keep
    log.append(f"{duplicates} coincident vertices merged")
    return representative


def _merge_near(
    vertices: np.ndarray, representative: np.ndarray, faces: np.ndarray, log: list[str]
) -> np.ndarray:
    """The representatives (V,), with vertices that an edge of all but no length joins made one.

    Left as they are if edges of three faces would come of it.
    """
    joined = representative[faces]
    pairs = topology.edges_of(joined).pairs
    used = vertices[np.unique(joined)]
    limit = COINCIDENT * float(np.linalg.norm(np.ptp(used, axis=0)))
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    short = pairs[(length <= limit) & (pairs[:, 0] != pairs[:, 1])]
    if len(short) == 0:
        return representative
    n = len(vertices)
    graph = coo_matrix((np.ones(len(short)), tuple(short.T)), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    nearest = np.unique(label, return_index=True)[1][label][representative]
    if _most_faces_at_an_edge(nearest[faces]) > 2 >= _most_faces_at_an_edge(joined):
        return representative
    count = len(np.unique(joined)) - len(np.unique(nearest[faces]))
    log.append(f"{count} vertices merged with neighbours at no distance")
    return nearest


def _most_faces_at_an_edge(faces: np.ndarray) -> int:
    """Over all edges, of faces that have three corners and are not there twice."""
    faces = faces[_distinct_corners(faces)]
    faces = faces[_first_uses(faces)]
    return int(topology.edges_of(faces).count.max()) if len(faces) else 0


def _distinct_corners(faces: np.ndarray) -> np.ndarray:
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


def _first_uses(faces: np.ndarray) -> np.ndarray:
    """Mask of faces whose three vertices are not those of an earlier face."""
    first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]
    mask = np.zeros(len(faces), dtype=bool)
    mask[first] = True
    return mask


def _drop_bad_faces(
    vertices: np.ndarray, faces: np.ndarray, name: str, log: list[str]
) -> np.ndarray:
    diagonal = float(np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0)))
    limit = DEGENERATE_HEIGHT * diagonal
    distinct = _distinct_corners(faces)
    if not distinct.all():
        log.append(f"{int((~distinct).sum())} faces with a repeated vertex removed")
    faces = faces[distinct]
    flat = _collapsed(vertices, faces, limit)
    if flat.all():
        raise NsmError(f"{name}: every face has zero area; give a mesh that is not collapsed")
    if flat.any():
        # taking a sliver out of the middle would tear a hole: only its removal by an edge flip
        # keeps the surface closed
        before = topology.euler_characteristic(faces[_first_uses(faces)])
        faces, flipped, removed = _remove_slivers(vertices, faces, flat, limit)
        kept = faces[_first_uses(faces)]
        if len(kept) == 0 or topology.euler_characteristic(kept) != before:
            raise NsmError(
                f"{name}: {removed} faces of zero area cannot be taken out without tearing the "
                "surface; merge vertices by distance in a mesh editor"
            )
        if flipped:
            log.append(f"{flipped} zero-area faces removed by edge flips")
        if removed:
            log.append(f"{removed} zero-area faces removed")
    first = _first_uses(faces)
    if not first.all():
        log.append(f"{int((~first).sum())} duplicate faces removed")
    return faces[first]


def _collapsed(vertices: np.ndarray, faces: np.ndarray, limit: float) -> np.ndarray:
    """Mask (F,) of the faces whose height over their longest side is below twice the limit."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    return topology.face_areas(vertices, faces) <= limit * longest


def _remove_slivers(
    vertices: np.ndarray, faces: np.ndarray, flat: np.ndarray, limit: float
) -> tuple[np.ndarray, int, int]:
    """Flip the longest edge of each collapsed face into its neighbour, or drop the face.

    A sliver between slivers may become flippable once its neighbour is; so they are gone through
    until none changes. Returns the faces, how many were flipped and how many dropped.
    """
    faces = faces.copy()
    faces_at: dict[tuple[int, int], set[int]] = {}
    for f, face in enumerate(faces.tolist()):
        for edge in _sides(face):
            faces_at.setdefault(edge, set()).add(f)
    slivers = np.flatnonzero(flat).tolist()
    flipped, changed = 0, True
    while changed:
        changed = False
        for f in list(slivers):
            g = _flip(vertices, faces, faces_at, f, limit)
            if g is not None:
                slivers = [h for h in slivers if h not in (f, g)]
                flipped += 1
                changed = True
    return np.delete(faces, slivers, axis=0), flipped, len(slivers)


def _flip(
    vertices: np.ndarray,
    faces: np.ndarray,
    faces_at: dict[tuple[int, int], set[int]],
    f: int,
    limit: float,
) -> int | None:
    """Flip the longest edge of face f in place if both new faces have area; the other face."""
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
    if _collapsed(vertices, pair, limit).any():
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


def _keep_main_part(
    vertices: np.ndarray, faces: np.ndarray, name: str, log: list[str]
) -> np.ndarray:
    label = topology.face_components(faces)
    count = int(label.max()) + 1
    if count == 1:
        return faces
    share = np.bincount(label, weights=topology.face_areas(vertices, faces))
    share = share / share.sum()
    main = int(share.argmax())
    others = np.delete(share, main)
    if others.max() >= DROPPED_SHARE or others.sum() >= DROPPED_TOTAL:
        listed = ", ".join(f"{100 * s:.1f} %" for s in np.sort(share)[::-1][:6])
        raise NsmError(
            f"{name}: {count} separate parts ({listed} of the area); "
            "keep one of them, or join them, in a mesh editor"
        )
    log.append(f"{count - 1} small separate parts dropped ({100 * others.sum():.2f} % of the area)")
    return faces[label == main]


def _orient(faces: np.ndarray, name: str, log: list[str]) -> np.ndarray:
    """Turn faces so that neighbours agree; most faces keep their side."""
    edges = topology.edges_of(faces)
    pairs = topology.adjacent_faces(edges)
    i, j = (pairs // 3).T  # the two faces at each inner edge
    disagree = faces.ravel()[pairs[:, 0]] == faces.ravel()[pairs[:, 1]]
    if not disagree.any():
        return faces
    # A face and its mirror image are two nodes; agreeing neighbours join like with like. A part
    # is one-sided exactly if some face ends up joined to its own mirror image.
    n = len(faces)
    a = np.concatenate([i, i + n])
    b = np.concatenate([np.where(disagree, j + n, j), np.where(disagree, j, j + n)])
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(2 * n, 2 * n)).tocsr()
    label = connected_components(graph, directed=False)[1]
    if (label[:n] == label[n:]).any():
        raise NsmError(f"{name}: one-sided (non-orientable) surface; cut it open in a mesh editor")
    turned = np.zeros(n, dtype=bool)
    done = np.zeros(n, dtype=bool)
    while not done.all():
        reached = breadth_first_order(
            graph, int(np.argmin(done)), directed=False, return_predecessors=False
        )
        kept, mirrored = reached[reached < n], reached[reached >= n] - n
        turned[mirrored if len(mirrored) <= len(kept) else kept] = True
        done[reached % n] = True
    faces = faces.copy()
    faces[turned] = faces[turned][:, [0, 2, 1]]
    log.append(f"{int(turned.sum())} faces turned round to agree with their neighbours")
    return faces
