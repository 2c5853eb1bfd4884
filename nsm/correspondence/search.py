"""The search for maps of two coarse shapes: from fours of tips to a few trained maps.

Four tips at the cones of the orbifold give a map, injective and orientation-preserving, in one
sparse solve. How well it keeps geodesic distances chooses some hundreds among thousands; these are
trained for a moment, and the least distorted ones again with finer waves (the criterion of ENIGMA:
Edelstein, Ezuz and Ben-Chen 2020, "Evolutionary non-isometric geometry matching").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import torch

from nsm.correspondence.coarse_shape import COMMON, CoarseShape
from nsm.correspondence.layouts import Layout, Table, affine_maps, layout, quick_scores, table
from nsm.correspondence.refinement import Anchors, Batch, Sines, refined
from nsm.domains.orbifold import group
from nsm.domains.orbifold.embedding import SIDE
from nsm.errors import NsmError
from nsm.stages import at, counted

_SOURCE_SETS = 4
_TARGET_SETS = 20
# weights of the squared distance, over the area, by which a map misses landmarks, and tips
_HOLD, _DRAW = 50.0, 1000.0


NOTHING = np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True)
class Round:
    """One round of trainings: how many maps, their largest wave, and steps."""

    maps: int
    largest: int
    steps: int


ROUNDS = (Round(400, 3, 12), Round(80, 5, 25), Round(16, 8, 40))
_THROUGH = Round(8, 8, 60)  # given landmarks, of five or more


@dataclass(frozen=True)
class Candidate:
    """A map of the orbifold to itself, x ↦ B (x + n(x)) + c, between two layouts.

    Attributes:
        source, target: the layouts.
        table: of the target.
        matrix, shift: B (2, 2) and c (2,), in coordinates of Ω.
        largest: of the waves of n.
        amplitudes: (K, 2) of the waves.
        cost: what orders candidates; after a training its loss.
        energy: after a training, the mean symmetric Dirichlet energy.
    """

    source: Layout
    target: Layout
    table: Table
    matrix: np.ndarray
    shift: np.ndarray
    largest: int
    amplitudes: np.ndarray
    cost: float
    energy: float = np.inf

    def planar(self, x: np.ndarray) -> np.ndarray:
        """Points (N, 2) of the source's Ω to points (N, 2) of the target's."""
        moved = x + Sines.up_to(self.largest).basis(x)[0] @ self.amplitudes
        return np.asarray(moved @ self.matrix.T + self.shift)

    def images(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices (N,) of the target near the images of vertices (N,) of the source."""
        return self.table.near(self.planar(self.source.embedding.uv[vertices]))

    def cones(self) -> np.ndarray:
        """The tips at the cones of the source, and those that they go to: (4, 2) vertices."""
        numbers = self.cone_numbers()
        tips = self.source.shape.tips[numbers[:, 0]], self.target.shape.tips[numbers[:, 1]]
        return np.stack(tips, axis=1)

    def cone_numbers(self) -> np.ndarray:
        """The same as numbers (4, 2) among the tips."""
        image = SIDE * group.CONES @ self.matrix.T + self.shift
        corner = np.mod(np.rint(image).astype(int), 2)
        wanted = np.rint(SIDE * group.CONES).astype(int)
        cones = [int(np.flatnonzero((wanted == c).all(axis=1))[0]) for c in corner]
        return np.stack([self.source.tips, self.target.tips[cones]], axis=1)


def candidates(
    source: CoarseShape, targets: Sequence[CoarseShape], rounds: Sequence[Round] = ROUNDS
) -> list[Candidate]:
    """Maps of the source to a target that may be right, least distorted first.

    Several targets are one surface whose handles were cut open elsewhere.

    Landmarks that are given on both shapes are held: a map does not take one to another tip, and
    what it misses them by is added to its energy. Of five or more, four are the cones.

    Raises:
        NsmError: ``no_proposal``: no map meets the landmarks that are given; ``not_injective``:
            of five or more, all fours are too close to each other.
    """
    if source.given_landmarks >= COMMON:
        found = through_four(source, targets[0], np.arange(source.given))
        drawn = [fixed_pairs(found[0])] * len(found)
        return sorted(trained(found, _THROUGH, drawn=drawn), key=lambda c: c.cost)
    sets, scores = quick_scores(source)
    ours = _laid_out(source, _least_distorted(source, sets, scores), "layouts of the source")
    theirs = [
        one
        for target, chosen in _similar_sets(ours, targets)
        for one in _laid_out(target, chosen, "layouts of the target")
    ]
    tables = [table(one) for one in theirs]
    found = [
        candidate
        for s in ours
        for t, looked_up in zip(theirs, tables, strict=True)
        for candidate in _starts(s, t, looked_up)
    ]
    if not found:
        raise NsmError(
            "no map of the surfaces meets the landmarks; give others, or more",
            kind="no_proposal",
            key="landmarks",
        )
    for k, one in enumerate(rounds):
        at("maps tried", k, len(rounds))
        found = trained(sorted(found, key=lambda c: c.cost)[: one.maps], one, held=True)
    return sorted(found, key=lambda c: c.cost)


def through_four(
    source: CoarseShape, target: CoarseShape, corresponding: np.ndarray
) -> list[Candidate]:
    """The affine maps that take four corresponding tips to each other, one for each isotopy class.

    Args:
        source, target: the shapes.
        corresponding: numbers (K,) of tips that correspond. The four are those of which both
            shapes' layouts are distorted least.

    Raises:
        NsmError: ``not_injective``: these four are too close to each other.
    """
    sets, first = quick_scores(source, corresponding)
    four = sets[int((first + quick_scores(target, corresponding)[1]).argmin())]
    a, b = layout(source, four), layout(target, four)
    if a is None or b is None:
        raise NsmError(
            "the landmarks lie too close to each other for a coarse map",
            kind="not_injective",
            key="landmarks",
        )
    looked_up, nothing = table(b), np.zeros((0, 2))
    found = [
        Candidate(a, b, looked_up, matrix, shift, 0, nothing, 0.0)
        for matrix, shift in affine_maps(a, b)
    ]
    wanted = np.stack([source.tips[four], target.tips[four]], axis=1)
    return [c for c in found if np.array_equal(c.cones(), wanted)]


def fixed_pairs(candidate: Candidate) -> np.ndarray:
    """Vertices (G, 2) of landmarks that were given."""
    return np.stack([candidate.source.shape.fixed, candidate.target.shape.fixed], axis=1)


def missed(candidate: Candidate) -> np.ndarray:
    """Distances (G,) from the images of landmarks that are given to where they should be."""
    s, t = candidate.source.shape, candidate.target.shape
    return np.asarray(t.distance[candidate.images(s.fixed), t.fixed])


def rigid_residual(
    source: CoarseShape, points: np.ndarray, target: CoarseShape, images: np.ndarray
) -> float:
    """Root mean square distance of vertices (N,), moved rigidly, to their images (N,)."""
    p, q = source.vertices[points], target.vertices[images]
    p, q = p - p.mean(axis=0), q - q.mean(axis=0)
    return float(np.sqrt(((p @ pose(p, q) - q) ** 2).sum(axis=1).mean()))


def pose(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The rotation R (3, 3) for which points p R (N, 3), about their mean, are nearest to q."""
    left, _, right = np.linalg.svd((p - p.mean(axis=0)).T @ (q - q.mean(axis=0)))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return np.asarray(left @ flip @ right)


def _least_distorted(shape: CoarseShape, sets: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Those of the sets (S, 4) of tips that distort least; of a shape with handles cut open, half
    of them with both stubs of a handle, which are long."""
    order = np.argsort(scores)
    if not len(shape.mesh.caps):
        return sets[order[:_SOURCE_SETS]]
    stubs = np.flatnonzero(np.isin(shape.ids[shape.tips], shape.mesh.caps)).reshape(-1, 2)
    both = np.array([np.isin(stubs, sets[k]).all(axis=1).any() for k in order])
    some = _SOURCE_SETS // 2
    return sets[np.concatenate([order[both][: _SOURCE_SETS - some], order[~both][:some]])]


def _laid_out(shape: CoarseShape, sets: np.ndarray, step: str) -> list[Layout]:
    every = [layout(shape, four) for four in counted(step, list(sets))]
    return [one for one in every if one is not None]


def _similar_sets(
    ours: Sequence[Layout], targets: Sequence[CoarseShape]
) -> list[tuple[CoarseShape, np.ndarray]]:
    """Sets (S, 4) of the targets' tips whose distances are those of one of the source's sets."""
    best = [_alike(ours, target) for target in targets]
    limit = sorted(cost for one in best for cost in one.values())[:_TARGET_SETS][-1:]
    found = []
    for target, costs in zip(targets, best, strict=True):
        kept = [four for four in sorted(costs, key=lambda f: costs[f]) if costs[four] <= limit[0]]
        if kept:
            found.append((target, np.array(kept[:_TARGET_SETS])))
    return found


def _alike(ours: Sequence[Layout], target: CoarseShape) -> dict[tuple[int, ...], float]:
    """Sets of four of the target's tips, and by how much their distances differ from those of one
    of the source's sets, at least."""
    apart = target.distance[np.ix_(target.tips, target.tips)]
    mean = target.mean_distance[target.tips]
    every = np.array(list(permutations(range(len(target.tips)), 4)))
    rows, columns = np.triu_indices(4, 1)
    best: dict[tuple[int, ...], float] = {}
    for one in ours:
        shape, tips = one.shape, one.shape.tips[one.tips]
        orders = every[_agree(one.tips, every, target.given).all(axis=1)]
        wanted = shape.distance[tips[rows], tips[columns]]
        cost = np.abs(wanted - apart[orders[:, rows], orders[:, columns]]).mean(axis=1)
        cost += np.abs(shape.mean_distance[tips] - mean[orders]).mean(axis=1)
        for value, four in zip(cost.tolist(), np.sort(orders, axis=1).tolist(), strict=True):
            best[tuple(four)] = min(best.get(tuple(four), np.inf), value)
    return best


def _agree(ours: np.ndarray, theirs: np.ndarray, given: int) -> np.ndarray:
    """Whether tips, by their numbers, may correspond: a given landmark only to itself."""
    return np.asarray((ours == theirs) | ((ours >= given) & (theirs >= given)))


def _starts(source: Layout, target: Layout, looked_up: Table) -> list[Candidate]:
    """The affine maps between two layouts, with the change of distances for their cost."""
    nothing = np.zeros((0, 2))
    made = [
        Candidate(source, target, looked_up, matrix, shift, 0, nothing, 0.0)
        for matrix, shift in affine_maps(source, target)
    ]
    given = source.shape.given
    numbers = [candidate.cone_numbers() for candidate in made]
    made = [c for c, n in zip(made, numbers, strict=True) if _agree(n[:, 0], n[:, 1], given).all()]
    if not made:
        return []
    images = np.stack([candidate.images(source.shape.samples) for candidate in made])
    costs = changes(source.shape, source.shape.samples, target.shape, images)
    if given:
        costs = costs + np.array([missed(c).mean() for c in made])
    return [replace(c, cost=float(cost)) for c, cost in zip(made, costs, strict=True)]


def changes(
    source: CoarseShape, points: np.ndarray, target: CoarseShape, images: np.ndarray
) -> np.ndarray:
    """Mean difference (...) of geodesic distances between vertices (N,) and between images (..., N)
    of them."""
    before = source.distance[np.ix_(points, points)]
    after = target.distance[images[..., :, None], images[..., None, :]]
    return np.asarray(np.abs(before - after).mean(axis=(-1, -2)))


def trained(
    found: Sequence[Candidate],
    one: Round,
    *,
    held: bool = False,
    drawn: Sequence[np.ndarray] | None = None,
) -> list[Candidate]:
    """The candidates after a round of trainings; those of one source in one batch.

    Args:
        found: the candidates.
        one: the round.
        held: whether maps take landmarks that were given near to one another.
        drawn: (L, 2) vertices of source and target, of each candidate, that are taken to one
            another with more force; none by default.
    """
    waves = len(Sines.up_to(one.largest).waves)
    by_shape: dict[int, dict[int, list[int]]] = {}  # and by layout
    for k, candidate in enumerate(found):
        layouts = by_shape.setdefault(id(candidate.source.shape), {})
        layouts.setdefault(id(candidate.source), []).append(k)
    result = list(found)
    for layouts in by_shape.values():
        members = [k for of_layout in layouts.values() for k in of_layout]
        group_ = [found[k] for k in members]
        tables = list({id(c.table): c.table for c in group_}.values())
        number = {id(t): k for k, t in enumerate(tables)}
        batch = Batch(
            [found[of_layout[0]].source for of_layout in layouts.values()],
            [len(of_layout) for of_layout in layouts.values()],
            tables,
            np.array([number[id(c.table)] for c in group_]),
            np.stack([c.matrix for c in group_]),
            np.stack([c.shift for c in group_]),
            one.largest,
            _anchors(
                group_,
                [fixed_pairs(c) if held else NOTHING for c in group_],
                [NOTHING if drawn is None else drawn[k] for k in members],
            ),
        )
        start = torch.zeros(len(group_), waves, 2)
        for k, candidate in enumerate(group_):  # few waves come first among many
            start[k, : len(candidate.amplitudes)] = torch.as_tensor(candidate.amplitudes)
        amplitudes, _ = refined(batch, start, one.steps)
        ends = zip(amplitudes, batch.energies(amplitudes), batch.losses(amplitudes), strict=True)
        for k, (values, energy, loss) in zip(members, ends, strict=True):
            result[k] = replace(
                found[k],
                largest=one.largest,
                amplitudes=values.numpy().astype(float),
                energy=float(energy),
                cost=float(loss),
            )
    return result


def _anchors(
    found: Sequence[Candidate], held: Sequence[np.ndarray], drawn: Sequence[np.ndarray]
) -> Anchors | None:
    count = len(held[0]) + max(map(len, drawn))
    if not count:
        return None
    points, places = np.zeros((2, len(found), count, 2))
    weights = np.zeros((len(found), count))
    shapes = np.zeros((len(found), 2, 2))
    for k, (candidate, own, more) in enumerate(zip(found, held, drawn, strict=True)):
        ours, theirs = candidate.source.embedding, candidate.target.embedding
        ids = np.concatenate([own, more])
        points[k, : len(ids)], places[k, : len(ids)] = ours.uv[ids[:, 0]], theirs.uv[ids[:, 1]]
        weights[k, : len(own)], weights[k, len(own) : len(ids)] = _HOLD, _DRAW
        shapes[k] = theirs.lattice / SIDE / np.sqrt(theirs.area)
    return Anchors(*(torch.as_tensor(a).float() for a in (points, places, shapes, weights)))
