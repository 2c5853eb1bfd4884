"""The four cones of an orbifold: extremities of the surface, chosen by the domain they give."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.sparse.csgraph import dijkstra

from nsm.domains.decimation import coarsen, finer, present_faces
from nsm.domains.orbifold.lifts import cone_lifts
from nsm.domains.orbifold.multiresolution import AREA, Effort, Hierarchy, hierarchy, laid_out
from nsm.domains.orbifold.newton import distortions
from nsm.errors import NsmError
from nsm.stages import counted
from nsm.surfaces import topology
from nsm.surfaces.geometry import edge_graph

_FACES = 3000  # of the mesh on which extremities are found, and the last candidates compared
LARGE = 40_000  # on larger meshes the cones are chosen on half as many
_FEW = 200  # of the mesh on which all candidates are compared, for good
# and where the best are compared again: of 22 closed shapes, one then got cones whose score is 3 %
# better than from 200 faces, three up to 1 % worse, the others the same, in 0.7 of the time
_FEWEST = 120
_EXTREMITIES = 6
_CLOSE = 0.12  # of the largest distance: two extremities nearer than this are one
_SOURCES = 96
_FINALISTS = 2
_LEAST = float(np.log(2 + 2 / 1.01))  # score of an isometry; ε of METHOD's energy is 0.01
_QUICK = Effort(coarse=_FEW, level=3, last=6, stop=1e-3)
_QUICKEST = Effort(coarse=_FEWEST, level=2, last=3, stop=1e-2)
_LONGER = Effort(level=3, last=8, stop=1e-3)


def decimated(
    vertices: np.ndarray, faces: np.ndarray, count: int, held: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """About ``count`` faces (F', 3) of a coarser mesh, and the vertices (V',) that it keeps."""
    return _without_gaps(coarsen(vertices, faces, _mask(len(vertices), held), count)[0])


def _mask(count: int, ids: np.ndarray | None) -> np.ndarray:
    """That (count,) of some vertices, or of none."""
    mask = np.zeros(count, dtype=bool)
    if ids is not None:
        mask[ids] = True
    return mask


def _without_gaps(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces (F', 3) without those that are gone, in new numbers, and the vertices (V',) left."""
    present = present_faces(faces)
    ids, local = topology.renumbered(present, int(present.max()) + 1)
    return local[present], ids


def extremities(vertices: np.ndarray, faces: np.ndarray, count: int = _EXTREMITIES) -> np.ndarray:
    """Up to ``count`` tips (K,) of a closed mesh (V, 3), (F, 3), the most prominent first.

    Farthest points, each moved to a maximum of the mean geodesic distance nearby.
    """
    coarse, ids = decimated(vertices, faces, _FACES)
    points = vertices[ids]
    n, graph = len(ids), edge_graph(points, coarse)

    def distance(v: int) -> np.ndarray:
        return np.asarray(dijkstra(graph, directed=False, indices=v))

    # sources spread evenly, by farthest points; weighted by the area that is nearest to each
    sources, nearest = [0], distance(0)
    rows = [nearest]
    while len(sources) < min(_SOURCES, n):
        sources.append(int(nearest.argmax()))
        rows.append(distance(sources[-1]))
        nearest = np.minimum(nearest, rows[-1])
    table = np.stack(rows)
    area = np.repeat(topology.face_areas(points, coarse) / 3, 3)
    of_vertex = np.bincount(coarse.ravel(), weights=area, minlength=n)
    weight = np.bincount(table.argmin(axis=0), weights=of_vertex, minlength=len(sources))
    mean = weight @ table / weight.sum()

    largest = float(table.max())
    chosen: list[int] = []
    away = mean  # the first: farthest from everything
    while len(chosen) < min(count, n):
        v = int(away.argmax())
        if chosen and away[v] < _CLOSE * largest:
            break
        near = distance(v) < 0.5 * _CLOSE * largest
        v = int(np.where(near, mean, -1.0).argmax())
        if v in chosen:
            # the maximum nearby is taken already: nothing new is to be found here
            away = np.where(near, 0.0, away)
            continue
        row = distance(v)
        away = row if not chosen else np.minimum(away, row)
        chosen.append(v)
    return ids[chosen]


def score(
    vertices: np.ndarray,
    faces: np.ndarray,
    cones: np.ndarray,
    effort: Effort,
    levels: Hierarchy | None = None,
) -> tuple[float, np.ndarray]:
    """A mesh laid out with given cones: the mean logarithm of the distortion, weighted by area, and
    the lattice (2, 2)."""
    lift, _ = cone_lifts(vertices, faces, cones.tolist())
    layout = laid_out(vertices, faces, lift, cones, effort=effort, levels=levels)
    x = layout.uv @ np.linalg.inv(layout.lattice).T
    area = topology.face_areas(vertices, faces)
    value = np.log(distortions(vertices, faces, layout.lift, x, layout.lattice))
    return float((area * value).sum() / area.sum()), layout.lattice


def choose_cones(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, list[tuple[float, tuple[int, ...]]]]:
    """Four vertices of a closed mesh (V, 3), (F, 3) of genus 0 whose orbifold is little distorted.

    The cones' cyclic order does not matter while the lattice's shape is free: another order is
    another basis of the lattice.

    Returns:
        the cones (4,), and the last scores, best first: mean logarithm of the distortion, and
        cones.
    """
    candidates = extremities(vertices, faces)
    if len(candidates) < 4:
        candidates = _four_apart(vertices, faces, candidates)
    sets = [np.array(four) for four in combinations(range(len(candidates)), 4)]
    found = compared([(vertices, faces)], [candidates], sets)
    table = [(s, tuple(candidates[four].tolist())) for s, four, _ in found]
    return np.array(table[0][1]), table


def compared(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]],
    candidates: Sequence[np.ndarray],
    sets: Sequence[np.ndarray],
    again: bool = True,
) -> list[tuple[float, np.ndarray, list[np.ndarray]]]:
    """Sets of four candidates, by the mean of the meshes' scores, best first.

    All are laid out on one or two hundred faces, but those that one mesh excludes already.

    Args:
        meshes: (V, 3) and (F, 3) of each.
        candidates: (K,) corresponding vertices of each.
        sets: which candidates (4,) each has.
        again: lay the two best out again on about 3,000 faces, and return these; without it, only
            the best set is sure to be among the results.

    Returns:
        of each set the mean score, the set, and the meshes' lattices (2, 2).
    """
    found: list[tuple[float, np.ndarray, list[np.ndarray]]] = []
    in_turn = [(_FEWEST, _QUICKEST), (_FACES, _LONGER)]
    if not again or len(sets) < 2:
        in_turn = [(_FEW, _QUICK)]
    fewest = in_turn[0][0]  # a mesh that is drawn together to so many faces was one of more before
    coarse = [
        coarsen(vertices, faces, _mask(len(vertices), ids), fewest)
        for (vertices, faces), ids in zip(meshes, candidates, strict=True)
    ]
    for count, effort in in_turn:
        each = [
            _Candidates(vertices, finer(*drawn, count), ids, effort)
            for (vertices, _), drawn, ids in zip(meshes, coarse, candidates, strict=True)
        ]
        found = _best(each, sets, _FINALISTS if again else 1)
        sets = [four for _, four, _ in found[:_FINALISTS]]
    return found


def _best(
    each: Sequence[_Candidates], sets: Sequence[np.ndarray], wanted: int
) -> list[tuple[float, np.ndarray, list[np.ndarray]]]:
    """As :func:`compared`, of meshes with their candidates; the ``wanted`` best are sure to be
    among the results."""
    first = [each[0].score(four) for four in counted("sets of cones tried on a mesh", sets)]
    found: list[tuple[float, np.ndarray, list[np.ndarray]]] = []
    order = np.argsort([score for score, _ in first], kind="stable").tolist()
    for k in counted("sets of cones tried on all meshes", order):
        ways = [first[k]]
        limit = sorted(score for score, _, _ in found)[wanted - 1 : wanted]
        for mesh in each[1:]:
            total = sum(score for score, _ in ways) + _LEAST * (len(each) - len(ways))
            if limit and total >= limit[0] * len(each):
                break
            ways.append(mesh.score(sets[k]))
        else:
            mean = float(np.mean([score for score, _ in ways]))
            found.append((mean, sets[k], [lattice for _, lattice in ways]))
    return sorted(found, key=lambda way: way[0])


class _Candidates:
    """Candidates for cones (K,) of a coarse mesh (V, 3), (F, 3), where faces that are gone have two
    equal corners; it is drawn together further once, for all sets of them."""

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, candidates: np.ndarray, effort: Effort
    ) -> None:
        self.faces, ids = _without_gaps(faces)
        self.vertices, self.effort = vertices[ids], effort
        self.candidates = np.searchsorted(ids, candidates)
        held = _mask(len(ids), self.candidates)
        self.levels = hierarchy(self.vertices, self.faces, held, effort, AREA[True])

    def score(self, four: np.ndarray) -> tuple[float, np.ndarray]:
        """As :func:`score`, with the cones at four candidates; infinite if there is no layout."""
        cones = self.candidates[four]
        try:
            return score(self.vertices, self.faces, cones, self.effort, self.levels)
        except NsmError:  # squeezed below what digits hold
            return np.inf, np.eye(2)


def _four_apart(vertices: np.ndarray, faces: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Four vertices far from each other, in space, that begin with those found."""
    used = np.unique(faces)
    chosen = [int(v) for v in found] or [int(used[0])]
    while len(chosen) < 4:
        gap = np.linalg.norm(vertices[used][:, None] - vertices[chosen][None], axis=2).min(axis=1)
        chosen.append(int(used[gap.argmax()]))
    return np.array(chosen)
