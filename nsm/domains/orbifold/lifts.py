"""Which lift of its vertex each corner of a closed mesh belongs to, in the cover of the domain.

A closed surface has no single-valued coordinates in the plane. Each vertex has one canonical
coordinate, and each triangle says, for its three corners, by which elements of the symmetry group
the canonical coordinates are moved so that the triangle lies in one piece.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, dijkstra

from nsm.domains.orbifold import group
from nsm.errors import NsmError
from nsm.surfaces import topology

# What takes the right-hand copy of a vertex of the cut to its left-hand copy, on v1v2, v2v3, v3v4.
_ACROSS = np.array([[-1, 0, 0], [1, -1, 0], [-1, 0, 1]])


def cone_lifts(
    vertices: np.ndarray, faces: np.ndarray, cones: Sequence[int]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Lifts of the corners of a closed mesh of genus 0 to the cover of the orbifold 2222.

    The mesh is cut along v1 → v2 → v3 → v4 (Aigerman and Lipman 2015, "Orbifold Tutte
    embeddings"). Where these paths lack room, edges are split; the lifts are those of the given
    faces all the same, and no vertex is doubled.

    Args:
        vertices: (V, 3).
        faces: (F, 3), one closed manifold component of genus 0, outward.
        cones: v1 to v4, four different vertices.

    Returns:
        lift (F, 3, 3), and the three paths, each (K, 3) points from cone to cone.

    Raises:
        NsmError: the mesh is not a closed sphere, or the cones are not four vertices of it.
    """
    corners = _checked_cones(vertices, faces, cones)
    mesh = _Split(vertices, faces)
    path = [corners[0]]
    ends = [0]
    for start, goal in zip(corners[:-1], corners[1:], strict=True):
        away = set(path) | set(corners)
        mesh.split_chords(away, path)
        path += mesh.shortest(start, goal, away)[1:]
        ends.append(len(path) - 1)
    lift = _fine_lifts(mesh, path, ends)
    paths = [mesh.points[path[a : b + 1]] for a, b in zip(ends[:-1], ends[1:], strict=True)]
    return _restricted(mesh, lift, len(faces), set(corners)), paths


def torus_lifts(faces: np.ndarray) -> np.ndarray:
    """Lifts (F, 3, 3) of the corners of a closed mesh of genus 1, (F, 3), to the plane.

    Two closed integer forms on the edges, dual to the loops of a tree-cotree decomposition
    (Eppstein 2003), say how often each edge goes around; they form a basis of integer cohomology.
    """
    edges = topology.edges_of(faces)
    if not (edges.count == 2).all() or topology.euler_characteristic(faces) != 0:
        raise NsmError(
            "the mesh is not a closed surface of genus 1; use another domain", kind="wrong_topology"
        )
    n = int(faces.max()) + 1
    pairs = edges.pairs
    graph = csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    order, parent = breadth_first_order(graph, int(faces[0, 0]), directed=False)
    child = order[1:].astype(np.int64)
    keys = pairs[:, 0] * n + pairs[:, 1]
    up = parent[child].astype(np.int64)
    in_tree = np.zeros(len(pairs), dtype=bool)
    in_tree[np.searchsorted(keys, np.minimum(child, up) * n + np.maximum(child, up))] = True
    crossing = topology.adjacent_faces(edges, ~in_tree)
    crossed = edges.of_corner.ravel()[crossing[:, 0]]
    dual = crossing // 3
    low, high = dual.min(axis=1), dual.max(axis=1)
    # two faces may share two edges: keep one of them for the cotree
    once = np.unique(low * len(faces) + high, return_index=True)[1]
    shape = (len(faces), len(faces))
    cograph = csr_matrix((np.ones(len(once)), (low[once], high[once])), shape=shape)
    order, parent = breadth_first_order(cograph, 0, directed=False)
    edge_between = dict(
        zip((low[once] * len(faces) + high[once]).tolist(), crossed[once].tolist(), strict=True)
    )

    def to_root(face: int) -> list[tuple[int, int]]:
        steps = []
        while parent[face] >= 0:
            above = int(parent[face])
            key = min(face, above) * len(faces) + max(face, above)
            steps.append((face, edge_between[key]))
            face = above
        return steps

    used = set()
    for face in order[1:].tolist():
        above = int(parent[face])
        used.add(edge_between[min(face, above) * len(faces) + max(face, above)])
    left = [k for k in range(len(crossed)) if int(crossed[k]) not in used]
    if len(left) != 2:
        raise NsmError("the mesh is not a connected torus", kind="wrong_topology")
    # +1 where a face runs along an edge from its lower to its higher vertex
    runs = np.where(faces < np.roll(faces, -1, axis=1), 1, -1)
    form = np.zeros((len(pairs), 2), dtype=np.int64)

    def leave(face: int, edge: int, number: int, count: int) -> None:
        """The dual path leaves a face through an edge."""
        k = int(np.flatnonzero(edges.of_corner[face] == edge)[0])
        form[edge, number] += count * runs[face, k]

    for number, k in enumerate(left):
        first, second = (int(f) for f in dual[k])
        leave(first, int(crossed[k]), number, 1)
        for face, edge in to_root(second):
            leave(face, edge, number, 1)
        for face, edge in to_root(first):
            leave(face, edge, number, -1)
    along = form[edges.of_corner] * runs[:, :, None]  # (F, 3, 2): corner k to k + 1
    # the integral of the first form times the second over the surface is 1 or -1
    if (along[:, 0, 0] * along[:, 1, 1] - along[:, 0, 1] * along[:, 1, 0]).sum() < 0:
        along = along[:, :, ::-1]
    lift = group.identities(len(faces), 3)
    lift[:, 1, 1:] = along[:, 0]
    lift[:, 2, 1:] = along[:, 0] + along[:, 1]
    return lift


def check_sphere(faces: np.ndarray) -> None:
    """Raise ``wrong_topology`` unless a mesh (F, 3) is one closed surface of genus 0."""
    edges = topology.edges_of(faces)
    used = np.zeros(int(faces.max()) + 1, dtype=bool)
    used[faces] = True
    euler = int(used.sum()) - len(edges.pairs) + len(faces)
    if euler != 2 or (edges.count != 2).any() or topology.face_components(faces).max():
        raise NsmError(
            "the mesh is not a closed surface of genus 0; use another domain", kind="wrong_topology"
        )


def _checked_cones(vertices: np.ndarray, faces: np.ndarray, cones: Sequence[int]) -> list[int]:
    check_sphere(faces)
    corners = [int(v) for v in cones]
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    if len(set(corners)) != 4 or len(corners) != 4:
        raise NsmError("cones must be four different vertices", kind="wrong_cones", key="cones")
    for v in corners:
        if not 0 <= v < len(vertices) or not used[v]:
            raise NsmError(f"cone {v} is no vertex of the mesh", kind="wrong_cones", key="cones")
    return corners


class _Split:
    """A mesh whose edges are split where paths need room; faces know what they are part of."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.points, self.faces, self.original = vertices, faces, faces
        self.parent = np.arange(len(faces))
        self.edges = topology.edges_of(faces)

    def split_chords(self, away: set[int], path: list[int]) -> None:
        """Split the edges that join two vertices of ``away``, except those of the path.

        Then paths that keep off these vertices exist: what is left of the sphere is connected.
        """
        edges = self.edges
        inside = np.zeros(len(self.points), dtype=bool)
        inside[list(away)] = True
        chord = inside[edges.pairs].all(axis=1)
        n = len(self.points)
        steps = np.sort(np.stack([path[:-1], path[1:]], axis=1), axis=1).reshape(-1, 2)
        steps = steps.astype(np.int64)
        chord &= ~np.isin(edges.pairs @ [n, 1], steps @ [n, 1])
        if not chord.any():
            return
        middle = np.full(len(edges.pairs), -1, dtype=np.int64)
        middle[chord] = n + np.arange(chord.sum())
        self.points = np.concatenate([self.points, self.points[edges.pairs[chord]].mean(axis=1)])
        mids = middle[edges.of_corner]
        touched = (mids >= 0).any(axis=1)
        new, parent = [], []
        for f in np.flatnonzero(touched).tolist():
            pieces = _pieces(self.faces[f].tolist(), mids[f].tolist())
            new += pieces
            parent += [self.parent[f]] * len(pieces)
        self.faces = np.concatenate([self.faces[~touched], np.array(new, dtype=np.int64)])
        self.parent = np.concatenate([self.parent[~touched], np.array(parent, dtype=np.int64)])
        self.edges = topology.edges_of(self.faces)

    def shortest(self, start: int, goal: int, away: set[int]) -> list[int]:
        """Vertices of the shortest path between two that meets no vertex of ``away`` between."""
        pairs = self.edges.pairs
        barred = np.zeros(len(self.points), dtype=bool)
        barred[list(away - {start, goal})] = True
        open_ = ~barred[pairs].any(axis=1)
        a, b = pairs[open_].T
        # a vertex may lie on another: no length is zero, which a sparse matrix would leave out
        length = np.linalg.norm(self.points[a] - self.points[b], axis=1)
        length = np.maximum(length, 1e-9 * max(float(length.max(initial=0.0)), 1e-300))
        n = len(self.points)
        graph = csr_matrix((length, (a, b)), shape=(n, n))
        _, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        path = [goal]
        while path[-1] != start:
            previous = int(before[path[-1]])
            if previous < 0:
                raise NsmError("no path joins the cones", kind="wrong_topology", key="cones")
            path.append(previous)
        return path[::-1]


def _pieces(corner: list[int], mid: list[int]) -> list[tuple[int, int, int]]:
    """The triangles of a face with the given middle vertices of its sides, -1 for none."""
    number = sum(m >= 0 for m in mid)
    if number == 3:
        (a, b, c), (ab, bc, ca) = corner, mid
        return [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    turn = next(k for k in range(3) if mid[k] >= 0 and (number == 1 or mid[(k + 1) % 3] >= 0))
    a, b, c = (corner[(turn + k) % 3] for k in range(3))
    ab, bc = mid[turn], mid[(turn + 1) % 3]
    if number == 1:
        return [(a, ab, c), (ab, b, c)]
    return [(ab, b, bc), (a, ab, bc), (a, bc, c)]


def _fine_lifts(mesh: _Split, path: list[int], ends: list[int]) -> np.ndarray:
    """Lifts (F', 3, 3) of the split mesh, cut open along the path."""
    n = len(mesh.points)
    steps = np.sort(np.stack([path[:-1], path[1:]], axis=1), axis=1)
    is_cut = np.isin(mesh.edges.pairs @ [n, 1], steps @ [n, 1])
    faces, origin = topology.cut_along(mesh.faces, is_cut)
    loop = topology.boundary_loops(faces)[0]
    loop = np.roll(loop, -int(np.flatnonzero(origin[loop] == path[0])[0]))
    # counter-clockwise around the domain: along the path, then back along its other side
    back = loop[len(path) :]
    of_copy = group.identities(len(origin))
    position = len(path) - 2 - np.arange(len(back))  # of the other side's vertices in the path
    segment = np.searchsorted(ends, position, side="right") - 1
    of_copy[back] = _ACROSS[segment]
    return of_copy[faces]


def _restricted(mesh: _Split, lift: np.ndarray, count: int, cones: set[int]) -> np.ndarray:
    """Lifts (count, 3, 3) of the faces before splitting, from those of their parts."""
    result = group.identities(count, 3)
    parts = np.bincount(mesh.parent, minlength=count)
    whole = parts[mesh.parent] == 1
    result[mesh.parent[whole]] = lift[whole]
    for face in np.flatnonzero(parts > 1).tolist():
        pieces = np.flatnonzero(mesh.parent == face)
        result[face] = _glued(
            mesh.faces[pieces].tolist(), lift[pieces], mesh.original[face].tolist(), cones
        )
    return result


def _glued(
    pieces: list[list[int]], lift: np.ndarray, corners: list[int], cones: set[int]
) -> np.ndarray:
    """Lifts (3, 3) of a face's corners, its parts (P, 3) brought into one place one by one."""
    at = {v: lift[0, k] for k, v in enumerate(pieces[0])}
    waiting = set(range(1, len(pieces)))
    while waiting:
        for p in sorted(waiting):
            shared = [v for v in pieces[p] if v in at]
            # a vertex that is no cone tells the element; sides of parts have at least one
            known = [v for v in shared if v not in cones]
            if len(shared) < 2 or not known:
                continue
            here = lift[p, pieces[p].index(known[0])]
            bring = group.compose(at[known[0]], group.inverse(here))
            for k, v in enumerate(pieces[p]):
                at.setdefault(v, group.compose(bring, lift[p, k]))
            waiting.remove(p)
            break
    return np.stack([at[v] for v in corners])
