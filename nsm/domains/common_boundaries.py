"""Open meshes cut alike, so that boundaries that correspond go to each other.

Meshes of genus 0 with several boundary loops are closed by a fan over each loop. The middles of
the fans are nodes of one tree on all meshes, as landmarks are (:mod:`nsm.domains.common_seams`).
Without the fans, its branches end on the boundaries, and the walk around the cut passes each
boundary between the same ends everywhere.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from nsm.domains.common_cut import SHARES, CommonCut, disagreement
from nsm.domains.common_seams import (
    SEAMS,
    aligned_keys,
    boundary_keys,
    corresponding_paths,
    edge_lengths,
    mutually_far,
    seam_costs,
)
from nsm.errors import NsmError
from nsm.stages import at
from nsm.surfaces import holes, topology
from nsm.surfaces.cutting import almost_closed, cut_along_paths
from nsm.surfaces.validation import CleanMesh

# Cost of an edge for each end on a boundary, in the unit of the square root of the area: branches
# reach a boundary only where they end.
_AT_BOUNDARY = 10.0


@dataclass(frozen=True)
class _Open:
    """An open mesh of genus 0, and what the common cut needs of it.

    Attributes:
        mesh: the mesh.
        loops: its boundary loops, in an order common to all meshes.
        closed: vertices (V + b, 3) and faces of the mesh with a fan over each loop; the middle of
            loop k is vertex V + k.
        landmarks: (L,) vertices that all meshes have.
        others: further vertices that no branch may touch.
    """

    mesh: CleanMesh
    loops: list[np.ndarray]
    closed: tuple[np.ndarray, np.ndarray]
    landmarks: np.ndarray
    others: np.ndarray

    @property
    def middles(self) -> np.ndarray:
        return len(self.mesh.vertices) + np.arange(len(self.loops))

    @property
    def on_boundary(self) -> np.ndarray:
        """(V + b,) mask of the vertices on loops."""
        mask = np.zeros(len(self.closed[0]), dtype=bool)
        mask[np.concatenate(self.loops)] = True
        return mask

    @property
    def loop_of_landmark(self) -> np.ndarray:
        """(L,) the loop that each landmark lies on, or -1."""
        loop = np.full(len(self.mesh.vertices), -1)
        for k, own in enumerate(self.loops):
            loop[own] = k
        return loop[self.landmarks]

    def costs(self, seam: str) -> np.ndarray:
        """(E,) of the closed mesh's edges."""
        vertices, faces = self.closed
        pairs = topology.edges_of(faces).pairs
        unit = float(np.sqrt(topology.face_areas(vertices, faces).sum()))
        ends = self.on_boundary[pairs].sum(axis=1)
        cost = seam_costs(vertices, faces, seam) + _AT_BOUNDARY * unit * ends
        cost[(pairs >= len(self.mesh.vertices)).any(axis=1)] = 1e-9 * unit
        return cost


def needs_common_boundaries(cleaned: Sequence[CleanMesh], landmarks: np.ndarray) -> bool:
    """Whether open meshes of genus 0 are cut, because they have several boundaries or a small one.

    Args:
        cleaned: the meshes, of one topology.
        landmarks: (L,) of one of them; through a single boundary no tree can be led without one.
    """
    loops = [topology.boundary_loops(c.faces) for c in cleaned]
    if len(loops[0]) != 1:
        return len(loops[0]) > 1
    small = [almost_closed(c.vertices, c.faces, own) for c, own in zip(cleaned, loops, strict=True)]
    return any(small) and len(landmarks) > 0


def best_common_boundaries(
    names: Sequence[str],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    seam: str,
    seam_landmarks: int | None,
    others: Sequence[np.ndarray],
) -> tuple[CommonCut, list[np.ndarray], list[str]]:
    """Open meshes of genus 0 cut to discs along corresponding paths between their boundaries.

    Args:
        names, cleaned, landmarks, seam, seam_landmarks, others: as for
            :func:`nsm.domains.common_cut.best_common_cut`.

    Returns:
        the cut; vertices (J,) of each mesh at which its paths end on boundaries, corresponding;
        and for each mesh a line that says which boundaries correspond.

    Raises:
        NsmError: ``no_common_seam``: landmarks say that boundaries do not correspond, or no paths
            were found.
    """
    shapes = _matched_loops(names, cleaned, landmarks, others)
    on_loop = shapes[0].loop_of_landmark >= 0
    inner = np.flatnonzero(~on_loop)
    least = 1 if len(shapes[0].loops) == 1 and not on_loop.any() else 0
    counts = sorted({max(least, round(share * len(inner))) for share in (0.0, *SHARES)})
    if seam_landmarks is not None or seam != "auto":
        wanted = len(inner) if seam_landmarks is None else seam_landmarks
        counts = [min(max(least, wanted), len(inner))]
    ways = list(itertools.product(SEAMS if seam == "auto" else (seam,), counts))
    costs = {path: [shape.costs(path) for shape in shapes] for path in {way[0] for way in ways}}
    tried = []
    for k, (path, count) in enumerate(ways):
        at("trying seams", k, len(ways))
        way = _common_cut(names, shapes, path, costs[path], inner, count)
        if way is not None:
            worst = disagreement(way[0], landmarks) if len(ways) > 1 else 0.0
            tried.append((worst, k, way))
    if not tried:
        raise NsmError(
            f"no corresponding cuts between the boundaries of {' and '.join(names)} were found: "
            "landmarks or boundaries are too close together for the meshes' edges; leave landmarks "
            "out, fill small holes with surface.fill_holes=true, or subdivide the meshes",
            kind="no_common_seam",
            key="landmarks",
        )
    cut, ends = min(tried)[2]
    first, *sizes = [", ".join(str(len(loop)) for loop in s.loops) for s in shapes]
    lines = [
        f"boundaries of {own} edges correspond to those of {first} edges of {names[0]}"
        for own in sizes
    ]
    return cut, ends, [f"boundaries of {first} edges", *lines]


def _matched_loops(
    names: Sequence[str],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    others: Sequence[np.ndarray],
) -> list[_Open]:
    """The meshes with their loops in the order of the first one's.

    Loops with a landmark in common correspond. The others are paired so that their lengths, and
    their distances from the landmarks, differ least.
    """
    shapes: list[_Open] = []
    for name, mesh, ids, more in zip(names, cleaned, landmarks, others, strict=True):
        loops = topology.boundary_loops(mesh.faces)
        shape = _closed(mesh, loops, ids, more)
        if shapes:
            first, own = shapes[0].loop_of_landmark, shape.loop_of_landmark
            _check_landmarks(names[0], name, first, own)
            cost = np.abs(_signature(shapes[0])[:, None] - _signature(shape)[None]).mean(axis=2)
            for a, b in zip(first[first >= 0], own[first >= 0], strict=True):
                cost[a, b] -= 1e3
            loops = [loops[k] for k in linear_sum_assignment(cost)[1]]
            shape = _closed(mesh, loops, ids, more)
            _check_order(names[0], name, shapes[0], shape)
        shapes.append(shape)
    return shapes


def _closed(
    mesh: CleanMesh, loops: list[np.ndarray], landmarks: np.ndarray, others: np.ndarray
) -> _Open:
    vertices, faces = holes.fans(mesh.vertices, mesh.faces, loops)
    return _Open(mesh, loops, (vertices, faces), landmarks, others)


def _signature(shape: _Open) -> np.ndarray:
    """(b, 1 + L) of each loop its length, and its distance from each landmark, over √area."""
    vertices, faces = shape.mesh.vertices, shape.mesh.faces
    n = len(vertices)
    graph = csr_matrix(
        (edge_lengths(vertices, faces), tuple(topology.edges_of(faces).pairs.T)), shape=(n, n)
    )
    rows = []
    for loop in shape.loops:
        side = vertices[loop] - vertices[np.roll(loop, -1)]
        away = dijkstra(graph, directed=False, indices=loop, min_only=True)[shape.landmarks]
        rows.append([np.linalg.norm(side, axis=1).sum(), *away])
    return np.array(rows) / np.sqrt(topology.face_areas(vertices, faces).sum())


def _check_landmarks(first_name: str, name: str, first: np.ndarray, own: np.ndarray) -> None:
    """NsmError for landmarks on loops, numbers (L,) or -1, that pair loops in different ways."""
    for k, (a, b) in enumerate(zip(first.tolist(), own.tolist(), strict=True)):
        if (a < 0) != (b < 0):
            there, not_there = (first_name, name) if b < 0 else (name, first_name)
            raise NsmError(
                f"landmark {k} is on a boundary of {there}, but not of {not_there}; move it, or "
                "leave it out",
                kind="no_common_seam",
                key="landmarks",
            )
        twice = (own[first == a] != b).any() or (first[own == b] != a).any()
        if a >= 0 and twice:
            raise NsmError(
                f"landmarks pair one boundary of {first_name} or {name} with two of the other; "
                f"landmark {k} is on it; leave the wrong ones out",
                kind="no_common_seam",
                key="landmarks",
            )


def _check_order(first_name: str, name: str, first: _Open, own: _Open) -> None:
    """NsmError for landmarks that two boundaries pass in different orders."""
    for a, b in zip(first.loops, own.loops, strict=True):
        keys = [
            boundary_keys(np.arange(len(s.mesh.vertices)), loop, s.landmarks)
            for s, loop in ((first, a), (own, b))
        ]
        if aligned_keys(keys) is None:
            orders = [key[:, 0].tolist() for key in keys]
            raise NsmError(
                f"boundaries pass the landmarks in different orders: {first_name} {orders[0]}, "
                f"{name} {orders[1]}, counter-clockwise; correct them, or leave some out",
                kind="no_common_seam",
                key="landmarks",
            )


def _common_cut(
    names: Sequence[str],
    shapes: Sequence[_Open],
    seam: str,
    costs: Sequence[np.ndarray],
    inner: np.ndarray,
    count: int,
) -> tuple[CommonCut, list[np.ndarray]] | None:
    """The meshes cut along one tree through all boundaries and ``count`` of the landmarks that are
    on none (I,), and the ends on boundaries (J,); None if there is no such tree."""
    closed = [shape.closed for shape in shapes]
    chosen = inner[:0]
    if count == 1:
        chosen = inner[:1]
    elif count:
        chosen = inner[mutually_far(closed, [s.landmarks[inner] for s in shapes], count)]
    loops = shapes[0].loop_of_landmark
    on_loop = np.flatnonzero(loops >= 0)
    passed = np.concatenate([on_loop, chosen])
    b = len(shapes[0].loops)
    nodes = [np.concatenate([s.middles, s.landmarks[passed]]) for s in shapes]
    begun = [(int(loops[k]), b + n) for n, k in enumerate(on_loop.tolist())]
    avoid = [np.concatenate([s.landmarks, s.others]) for s in shapes]
    paths = corresponding_paths(closed, nodes, costs, avoid=avoid, begun=begun)
    if paths is None:
        return None
    cuts, keyed, ends = [], [], []
    for shape, own, name in zip(shapes, paths, names, strict=True):
        n = len(shape.mesh.vertices)
        kept = [[v for v in path if v < n] for path in own]
        kept = [path for path in kept if len(path) > 1]
        if any(shape.on_boundary[path[1:-1]].any() for path in kept) or not kept:
            return None
        at_ends = [
            inside
            for path in own
            for end, inside in ((path[0], path[1]), (path[-1], path[-2]))
            if end >= n
        ]
        landed = np.setdiff1d(at_ends, shape.landmarks[passed])
        order = [v for v in at_ends if v in set(landed.tolist())]
        ends.append(np.array(order, dtype=np.int64))
        keyed.append(np.concatenate([shape.landmarks[passed], ends[-1]]))
        vertices, faces = shape.mesh.vertices, shape.mesh.faces
        cuts.append(cut_along_paths(vertices, faces, kept, name=name))
    keys = aligned_keys(
        [boundary_keys(cut.origin, cut.loop, ids) for cut, ids in zip(cuts, keyed, strict=True)]
    )
    if keys is None:
        return None
    return CommonCut(seam, len(passed), cuts, [key[:, 1] for key in keys]), ends
