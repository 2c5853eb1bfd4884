"""Edges, boundary loops, connected components and cuts of triangle meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class Edges:
    """Undirected edges of a mesh.

    Attributes:
        pairs: (E, 2) vertices of each edge, the smaller first.
        of_corner: (F, 3) the edge from corner k to corner k + 1 of each face.
        count: (E,) how many faces use the edge.
    """

    pairs: np.ndarray
    of_corner: np.ndarray
    count: np.ndarray


def edges_of(faces: np.ndarray) -> Edges:
    """The edges of faces (F, 3), sorted by their vertices."""
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    ordered = np.sort(directed, axis=1)
    base = int(faces.max()) + 1 if len(faces) else 1
    keys, inverse, count = np.unique(
        ordered[:, 0] * base + ordered[:, 1], return_inverse=True, return_counts=True
    )
    pairs = np.stack([keys // base, keys % base], axis=1)
    return Edges(pairs, inverse.reshape(-1, 3), count)


def edges_between(pairs: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """The numbers (N,) of the edges between vertices (N, 2), among those (E, 2) of
    :func:`edges_of`."""
    count = int(pairs.max()) + 1
    low, high = np.sort(ends, axis=1).T
    return np.searchsorted(pairs[:, 0] * count + pairs[:, 1], low * count + high)


def adjacent_faces(edges: Edges, keep: np.ndarray | None = None) -> np.ndarray:
    """The two corners 3f + k (N, 2) at which each edge with two faces starts.

    Args:
        edges: the edges of the mesh.
        keep: (E,) mask of the edges to look at; default all.
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
    """Connected component (F,) of each face, from 0; faces that share a vertex are connected."""
    n = int(faces.max()) + 1
    i = np.concatenate([faces[:, 0], faces[:, 1]])
    j = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    labels = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.unique(labels, return_inverse=True)[1]


def cut_along(faces: np.ndarray, is_cut: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut a mesh open along edges.

    Each vertex gets one copy per fan of faces that remains connected around it; so non-manifold
    vertices are split even if nothing is cut.

    Args:
        faces: (F, 3).
        is_cut: (E,) mask of the edges to cut, in the order of :func:`edges_of`.

    Returns:
        The new faces (F, 3), and the old index of each new vertex, in rising order.
    """
    edges = edges_of(faces)
    pairs = adjacent_faces(edges, ~is_cut)
    face, corner = pairs // 3, pairs % 3
    following = face * 3 + (corner + 1) % 3
    flat = faces.ravel()
    # connect the two corners at each end of the edge, for both orientations of the second face
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
    """Boundary loops of an oriented manifold mesh, those with most vertices first.

    Each is an array of vertices in the direction of the faces: counter-clockwise for a planar mesh
    of counter-clockwise faces.
    """
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
    """V - E + F, over the vertices that the faces use."""
    return len(np.unique(faces)) - len(edges_of(faces).pairs) + len(faces)


def genus_and_boundary(faces: np.ndarray) -> tuple[int, int]:
    """Genus and number of boundary loops of an oriented surface of one component."""
    loops = len(boundary_loops(faces))
    return (2 - euler_characteristic(faces) - loops) // 2, loops


def is_disc(faces: np.ndarray) -> bool:
    """Whether a mesh has one component, one boundary loop and Euler characteristic 1."""
    return (
        int(face_components(faces).max()) == 0
        and euler_characteristic(faces) == 1
        and len(boundary_loops(faces)) == 1
    )


def renumbered(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The vertices (N,) of n that faces (F, 3) use, and the new index (n,) of each.

    The new index of an unused vertex has no meaning.
    """
    used = np.zeros(n, dtype=bool)
    used[faces] = True
    return np.flatnonzero(used), np.cumsum(used) - 1


def cross_product(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Of vectors (3, ...), by coordinates: (3, ...)."""
    return np.array(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas (F,) of the triangles of a 3D mesh, in the square of its unit."""
    # by coordinates: this is asked for often, of few faces
    a, b, c = vertices.T.take(faces.T, axis=1).transpose(1, 0, 2)
    u, v = b - a, c - a
    cross = cross_product(u, v)
    return np.asarray(0.5 * np.sqrt((cross * cross).sum(axis=0)))


def equal_faces(there: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of (G, 3) and of (F, 3) with the same three numbers, none negative: pairs (M,), (M,)."""
    rows = np.sort(np.concatenate([there, here]), axis=1).astype(np.int64)
    # by numbers of rows, which are sorted sooner than rows; those with a negative are not used
    span = rows.max(initial=0) + 1
    pair = np.unique(rows[:, 0] * span + rows[:, 1], return_inverse=True)[1]
    number = np.unique(pair * span + rows[:, 2], return_inverse=True)[1]
    usable = np.asarray((rows >= 0).all(axis=1))
    first = np.full(number.max() + 1, -1)
    mine = np.flatnonzero(usable[: len(there)])[::-1]  # the first of equal faces is taken
    first[number[mine]] = mine
    match = np.where(usable[len(there) :], first[number[len(there) :]], -1)
    found = np.flatnonzero(match >= 0)
    return match[found], found
