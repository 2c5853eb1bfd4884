"""Ends of limbs that landmarks leave out: matched by what it costs a map to meet them.

Five landmarks or more fix the isotopy class of a map, not where it ends a limb without a landmark,
or where a head ends and a neck begins. Ends of small limbs, such as ears and short tails, tell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape, coarse_shape
from nsm.correspondence.distances import edge_distances
from nsm.correspondence.scores import score
from nsm.correspondence.search import Round, fixed_pairs, through_four, trained
from nsm.correspondence.tips import limb_ends
from nsm.surfaces import topology

FACES = 2000
ROUND = Round(0, 8, 40)  # through the known landmarks
DRAWN = Round(0, 12, 60)  # with ends drawn together
_SMALL = 0.02  # least prominence, over √area
_SAME = 0.1  # of an end to a known landmark, over √area
_FAR = 0.35  # of an end's image to the end that may correspond to it, over √area
_RIVAL, _AS_LARGE = 1.2, 0.8  # ends that are nearly as near, and nearly as large
_COST = 0.05  # by which the score may rise for each pair of ends
_AHEAD = 0.03  # by which it must be lower than that of as many other pairs
_PAIRS, _TRIED = 10, 48  # of which matchings are made, and how many are tried

Mesh = tuple[np.ndarray, np.ndarray]
Pair = tuple[int, int]


def further_ends(meshes: tuple[Mesh, Mesh], known: np.ndarray) -> np.ndarray:
    """Corresponding ends of limbs, as vertices (L, 2) of two closed meshes of genus 0.

    Ends may correspond where a map through the known landmarks brings them near to each other. Of
    all sets of such pairs the largest is taken through which a map has a score that is hardly
    higher. An end stays alone where another one would do as well, or nearly as well.

    Args:
        meshes: vertices (V, 3) and faces (F, 3) of source and target.
        known: (G, 2) landmarks, five or more; ends near them are left out.

    Raises:
        NsmError: ``not_injective``, as :func:`nsm.correspondence.search.through_four`.
    """
    ends, heights = zip(*(_ends(mesh, known[:, k]) for k, mesh in enumerate(meshes)), strict=True)
    if not all(map(len, ends)):
        return np.zeros((0, 2), dtype=np.int64)
    source, target = (
        coarse_shape(*mesh, tips=np.concatenate([fixed, own]), fixed=fixed, count=FACES)
        for mesh, fixed, own in zip(meshes, known.T, ends, strict=True)
    )
    starts = through_four(source, target, np.arange(len(known)))
    held = fixed_pairs(starts[0])
    best = min(trained(starts, ROUND, drawn=[held] * len(starts)), key=lambda c: c.cost)
    apart = target.distance[np.ix_(best.images(_of(source)), _of(target))]
    tried = [[], *_matchings(apart, *heights)]
    drawn = [np.concatenate([held, _vertices(source, target, pairs)]) for pairs in tried]
    scores = np.array([score(one) for one in trained([best] * len(tried), DRAWN, drawn=drawn)])
    taken = _largest(tried, scores)
    return np.array([(ends[0][i], ends[1][j]) for i, j in taken], dtype=np.int64).reshape(-1, 2)


def _ends(mesh: Mesh, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (S,) at ends of limbs without a landmark, and their prominences (S,)."""
    found, height = limb_ends(*mesh, _SMALL)
    unit = np.sqrt(topology.face_areas(*mesh).sum())
    free = edge_distances(*mesh, known)[:, found].min(axis=0) > _SAME * unit
    return found[free], height[free]


def _of(shape: CoarseShape) -> np.ndarray:
    return shape.tips[shape.given :]


def _vertices(source: CoarseShape, target: CoarseShape, pairs: Sequence[Pair]) -> np.ndarray:
    numbers = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return np.stack([_of(source)[numbers[:, 0]], _of(target)[numbers[:, 1]]], axis=1)


def _largest(tried: Sequence[list[Pair]], scores: np.ndarray) -> list[Pair]:
    """The pairs of the largest set that is worth its score (N,): of several those that are in all
    of the nearly best ones. The first set is empty."""
    count = np.array([len(pairs) for pairs in tried])
    possible = scores <= scores[0] + _COST * count
    largest = possible & (count == count[possible].max())
    best = largest & (scores <= scores[largest].min() + _AHEAD)
    return sorted(set.intersection(*(set(tried[k]) for k in np.flatnonzero(best).tolist())))


def _matchings(apart: np.ndarray, ours: np.ndarray, theirs: np.ndarray) -> list[list[Pair]]:
    """Sets of pairs of ends, each end in one pair at most, that no other end would fit as well.

    Args:
        apart: (S, T) distances from images of ends to ends of the target.
        ours, theirs: prominences (S,) and (T,).
    """
    pairs = sorted(map(tuple, np.argwhere(apart < _FAR).tolist()), key=lambda p: apart[p])[:_PAIRS]
    found: list[list[Pair]] = [[]]
    for i, j in pairs:
        found += [[*one, (i, j)] for one in found if all(i != a and j != b for a, b in one)]
    clear = [one for one in found if one and _clear(one, apart, ours, theirs)]
    return sorted(clear, key=lambda one: (-len(one), sum(apart[p] for p in one)))[:_TRIED]


def _clear(pairs: Sequence[Pair], apart: np.ndarray, ours: np.ndarray, theirs: np.ndarray) -> bool:
    """Whether no end that is left alone is nearly as near, and as large, as one that is taken."""
    for table, heights, both in (
        (apart, ours, pairs),
        (apart.T, theirs, [(j, i) for i, j in pairs]),
    ):
        alone = np.setdiff1d(np.arange(len(heights)), [i for i, _ in both])
        for i, j in both:
            near = table[alone, j] < _RIVAL * table[i, j]
            if (near & (heights[alone] > _AS_LARGE * heights[i])).any():
                return False
    return True
