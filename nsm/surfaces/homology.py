"""First homology modulo 2 of closed meshes: which closed curves separate a surface, and which of
them are closed by a disc within the solid.

Curves are told apart by the parity of their crossings with a basis of closed curves on the faces
(tree-cotree decomposition: Erickson and Whittlesey 2005, "Greedy optimal homotopy and homology
generators").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, dijkstra
from scipy.spatial.transform import Rotation

from nsm.surfaces import topology

_PUSHED = 0.01  # of the mean edge: by which curves are lifted off the surface


def crossings(faces: np.ndarray, on_seam: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """(E,) of each edge, as bits, which closed curves of a basis cross it: curves on the faces
    that no cut stops.

    Args:
        faces: (F, 3) of a closed mesh.
        on_seam: (V,) mask of the vertices of a connected seam, at least one.
        cut: (E,) mask of its edges.
    """
    edges, n = topology.edges_of(faces), len(on_seam)
    # a tree of all vertices, of which those on the seam are one
    one = np.where(on_seam, n, np.arange(n))
    ends = one[edges.pairs]
    graph = csr_matrix((np.ones(len(ends)), tuple(ends.T)), shape=(n + 1, n + 1))
    order, before = breadth_first_order(graph, n, directed=False)
    parents = before[order[1:]].astype(np.int64)
    wanted = np.minimum(order[1:], parents) * (n + 1) + np.maximum(order[1:], parents)
    low, high = np.sort(ends, axis=1).T
    both = low * (n + 1) + high
    sorted_, first = np.unique(both, return_index=True)
    in_tree = np.zeros(len(ends), dtype=bool)
    in_tree[first[np.searchsorted(sorted_, wanted)]] = True
    # a tree of all faces, over other edges; each edge that is left closes a curve
    corners = topology.adjacent_faces(edges, ~cut & ~in_tree)
    over = edges.of_corner.ravel()[corners[:, 0]]
    beside = np.sort(corners // 3, axis=1)
    count = len(faces)
    dual = csr_matrix((np.ones(len(beside)), tuple(beside.T)), shape=(count, count))
    order, before = breadth_first_order(dual, 0, directed=False)
    number_of = {tuple(pair): e for pair, e in zip(beside.tolist(), over.tolist(), strict=True)}
    step: dict[int, int] = {}  # the edge between each face and the one before it
    for face in order[1:].tolist():
        low, high = sorted((face, int(before[face])))
        step[face] = number_of[low, high]
    bits = np.zeros(len(ends), dtype=np.int64)
    left = ~np.isin(over, list(step.values()))
    for k, (edge, pair) in enumerate(zip(over[left].tolist(), beside[left].tolist(), strict=True)):
        bits[edge] ^= 1 << k
        for face in pair:
            while face in step:
                bits[step[face]] ^= 1 << k
                face = int(before[face])
    return bits


class ShortLoops(NamedTuple):
    """The shortest closed curves along edges through some vertices, of each class of homology.

    Attributes:
        length: (R, C) of the curve through each root, of each class that does not separate the
            surface; the classes are 1 to C.
        loops: (R, C) of them its vertices, in turn; without the way from the root to the curve,
            where both its ends take it.
        distance: (R, V) geodesic, along edges, from the roots.
    """

    length: np.ndarray
    loops: list[list[np.ndarray]]
    distance: np.ndarray


def short_loops(vertices: np.ndarray, faces: np.ndarray, roots: np.ndarray) -> ShortLoops:
    """Short closed curves of a closed mesh (V, 3), (F, 3) of genus g through roots (R,).

    Classes are those of H₁ modulo 2, 4^g - 1 that are not zero.
    """
    edges = topology.edges_of(faces).pairs
    n = len(vertices)
    rooted = np.zeros(n, dtype=bool)
    rooted[faces[0, 0]] = True
    bits = crossings(faces, rooted, np.zeros(len(edges), dtype=bool))
    x, y = edges.T
    side = np.linalg.norm(vertices[x] - vertices[y], axis=1)
    graph = csr_matrix((side, (x, y)), shape=(n, n))
    distance, before = dijkstra(graph, directed=False, indices=roots, return_predecessors=True)
    keys = x * n + y  # sorted
    genus = topology.genus_and_boundary(faces)[0]
    count = 4**genus - 1
    length = np.full((len(roots), count), np.inf)
    loops = []
    for k, root in enumerate(roots.tolist()):
        came = before[k].astype(np.int64)
        reached = np.flatnonzero(came >= 0)
        low, high = np.sort([reached, came[reached]], axis=0)
        crossed = np.zeros(n, dtype=np.int64)
        crossed[reached] = bits[np.searchsorted(keys, low * n + high)]
        came[root] = root
        jump = came.copy()
        while (jump != root).any():  # along the way, twice as far each time
            crossed ^= crossed[jump]
            jump = jump[jump]
        around = distance[k][x] + side + distance[k][y]
        of_class = crossed[x] ^ bits ^ crossed[y]
        order = np.lexsort((around, of_class))
        classes, first = np.unique(of_class[order], return_index=True)
        own: list[np.ndarray] = [np.zeros(0, dtype=np.int64)] * count
        for one, edge in zip(classes.tolist(), order[first].tolist(), strict=True):
            if one:
                length[k, one - 1] = around[edge]
                own[one - 1] = _loop(came, root, int(x[edge]), int(y[edge]))
        loops.append(own)
    return ShortLoops(length, loops, distance)


def _loop(before: np.ndarray, root: int, a: int, b: int) -> np.ndarray:
    """The curve from a root to a, over an edge to b, and back, without the way that is common."""
    ways = []
    for v in (a, b):
        way = [v]
        while way[-1] != root:
            way.append(int(before[way[-1]]))
        ways.append(way[::-1])
    common = 0
    while common < min(map(len, ways)) and ways[0][common] == ways[1][common]:
        common += 1
    return np.array([ways[0][common - 1], *ways[0][common:], *ways[1][common:][::-1]])


def linking_number(first: np.ndarray, second: np.ndarray) -> int:
    """Of two closed polygons (N, 3) and (M, 3) that do not meet: signed crossings in a picture of
    both, where the first is in front."""
    turn = Rotation.from_rotvec([0.3, 1.1, -0.7]).as_matrix()  # a general direction
    p, q = first @ turn.T, second @ turn.T
    r, s = np.roll(p, -1, axis=0) - p, np.roll(q, -1, axis=0) - q
    p, r, q, s = p[:, None], r[:, None], q[None], s[None]

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

    turned = cross(r, s)
    with np.errstate(divide="ignore", invalid="ignore"):
        t, u = cross(q - p, s) / turned, cross(q - p, r) / turned
        meet = (t >= 0) & (t < 1) & (u >= 0) & (u < 1)
        front = p[..., 2] + t * r[..., 2] > q[..., 2] + u * s[..., 2]
    return int(np.sign(turned[meet & front]).sum())


def lifted(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The vertices (V, 3) moved a little to the outer side of a closed mesh (F, 3), whichever way
    its faces turn."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    across *= np.sign(((a - vertices.mean(axis=0)) * across).sum())  # of the volume
    normal = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normal, faces[:, k], across)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(min=1e-300)
    edge = float(np.linalg.norm(b - a, axis=1).mean())
    return vertices + _PUSHED * edge * normal
