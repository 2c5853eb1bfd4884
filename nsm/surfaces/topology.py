"""Edges, boundary loops, Euler characteristic and corner gluing of triangle meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class Edges:
    """Undirected edges of a mesh.

    pairs (E,2) sorted vertex pairs; of_corner (F,3) edge from corner k to corner k+1 of a face;
    count (E,) how many faces use the edge.
    """

    pairs: np.ndarray
    of_corner: np.ndarray
    count: np.ndarray


def edges_of(faces: np.ndarray) -> Edges:
    """The edges of faces (F,3)."""
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    ordered = np.sort(directed, axis=1)
    base = int(faces.max()) + 1 if len(faces) else 1
    keys, inverse, count = np.unique(
        ordered[:, 0] * base + ordered[:, 1], return_inverse=True, return_counts=True
    )
    pairs = np.stack([keys // base, keys % base], axis=1)
    return Edges(pairs, inverse.reshape(-1, 3), count)


def adjacent_faces(edges: Edges, keep: np.ndarray | None = None) -> np.ndarray:
    """Corner pairs (N,2): flat corner indices 3f+k of the two uses of each two-face edge.

    Only edges with keep[e] true, when given.
    """
    flat = edges.of_corner.ravel()
    order = np.argsort(flat, kind="stable")
    two = edges.count == 2
    if keep is not None:
        two = two & keep
    start = np.concatenate([[0], np.cumsum(edges.count)[:-1]])
    first = start[two]
    return np.stack([order[first], order[first + 1]], axis=1)


def face_components(faces: np.ndarray) -> np.ndarray:
    """Component label (F,) of each face; faces that share a vertex belong together."""
    n = int(faces.max()) + 1
    i = np.concatenate([faces[:, 0], faces[:, 1]])
    j = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    labels = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.unique(labels, return_inverse=True)[1]


def cut_along(faces: np.ndarray, is_cut: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut a mesh open along the edges with is_cut (E,) true, edges numbered as in edges_of.

    Each vertex gets one copy for every fan of faces that still hangs together around it, so that
    a vertex whose faces only touch at the point is split even if nothing is cut. Returns the new
    faces (F,3) and, for each new vertex, its old index (sorted by it).
    """
    edges = edges_of(faces)
    pairs = adjacent_faces(edges, ~is_cut)
    face, corner = pairs // 3, pairs % 3
    following = face * 3 + (corner + 1) % 3
    flat = faces.ravel()
    # glue the two corners at each end of the edge, whichever way round the second face runs
    i, j = pairs.T
    same = flat[i] == flat[j]
    a = np.concatenate([i, following[:, 0]])
    b = np.concatenate([np.where(same, j, following[:, 1]), np.where(same, following[:, 1], j)])
    n = faces.size
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    old = np.zeros(count, dtype=np.int64)
    old[label] = flat
    order = np.argsort(old, kind="stable")
    rank = np.empty(count, dtype=np.int64)
    rank[order] = np.arange(count)
    return rank[label].reshape(-1, 3), old[order]


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Boundary loops of an oriented manifold mesh, each an array of vertices in the order in which
    the faces run along them (counter-clockwise for a counter-clockwise flat mesh), longest (by
    number of vertices) first."""
    edges = edges_of(faces)
    face, corner = np.nonzero(edges.count[edges.of_corner] == 1)
    tails, heads = faces[face, corner], faces[face, (corner + 1) % 3]
    following = dict(zip(tails.tolist(), heads.tolist(), strict=True))
    loops = []
    while following:
        start, vertex = following.popitem()
        loop = [start]
        while vertex != start:
            loop.append(vertex)
            vertex = following.pop(vertex)
        loops.append(np.array(loop, dtype=np.int64))
    return sorted(loops, key=lambda loop: (-len(loop), int(loop.min())))


def euler_characteristic(faces: np.ndarray) -> int:
    """V - E + F over the vertices that faces use."""
    return len(np.unique(faces)) - len(edges_of(faces).pairs) + len(faces)


def is_disc(faces: np.ndarray) -> bool:
    """One component, Euler characteristic 1 and one boundary loop."""
    return (
        int(face_components(faces).max()) == 0
        and euler_characteristic(faces) == 1
        and len(boundary_loops(faces)) == 1
    )


def renumbered(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Of n vertices, those (N,) that faces (F, 3) name, in rising order, and the number (n,) of
    each among them; of the others it means nothing."""
    used = np.zeros(n, dtype=bool)
    used[faces] = True
    return np.flatnonzero(used), np.cumsum(used) - 1


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas (F,) of the triangles of a 3D mesh, in the square of its unit."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
