"""Correspondences of several closed surfaces without landmarks: one with each other one.

Every surface is matched with a hub. Which of the hypotheses are taken is decided for all surfaces
together: two maps from the hub also make one between their targets, which has its own change of
distances and its own rigid residual. Near ties of a member's maps are decided by finer maps. Ends
of small limbs come to landmarks that are sure, as they do for pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from nsm.correspondence.coarse_shape import COMMON, CoarseShape, coarse_shape
from nsm.correspondence.joint_choice import Way, ways
from nsm.correspondence.layouts import quick_scores
from nsm.correspondence.proposal import (
    LEAST_LANDMARKS,
    LEAST_MARGIN,
    Hypothesis,
    completed,
    hypotheses,
    told_apart,
)
from nsm.correspondence.scores import compared
from nsm.stages import counted

_KEPT = 5


@dataclass(frozen=True)
class CollectionProposal:
    """Landmarks of several surfaces, and how sure they are.

    Attributes:
        vertices: of each hypothesis (L, k) corresponding vertices, best first; the given ones
            before others. Of the best, if it is sure, ends of limbs of all members, too.
        scores: (H,) mean of the members' scores and of those of the maps between them.
        margin: by how much the total of the scores rises, for each member that changes, if another
            hypothesis of one is taken; or less, if it was less before finer maps were compared.
        given: how many landmarks were given.
        sure: whether all members are far ahead, and good in themselves.
    """

    vertices: list[np.ndarray]
    scores: list[float]
    margin: float
    given: int
    sure: bool


def proposed_for_all(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]], given: np.ndarray | None = None
) -> CollectionProposal:
    """Propose landmarks of several closed meshes of genus 0.

    Args:
        meshes: vertices (V, 3) and faces (F, 3) of each, k of them.
        given: (G, k) corresponding vertices that are kept and completed; none by default.

    Raises:
        NsmError: as :func:`nsm.correspondence.proposal.proposed`.
    """
    k = len(meshes)
    fixed = np.zeros((0, k), dtype=np.int64) if given is None else given
    shapes = [coarse_shape(*mesh, fixed=fixed[:, i]) for i, mesh in enumerate(meshes)]
    hub = hub_of(shapes)
    others = [i for i in range(k) if i != hub]
    found = {i: hypotheses(shapes[hub], [shapes[i]]) for i in others}
    own = {i: np.array([h.score for h in found[i]]) for i in others}
    between = {
        (i, j): np.array([[_between(g, h) for h in found[j]] for g in found[i]]) / (k - 2)
        for i, j in combinations(others, 2)
    }
    found_ways = ways(own, between)
    margin = _margin(found_ways)
    if margin <= LEAST_MARGIN and len(fixed) < COMMON:
        for i, numbers in counted("finer maps", list(_near(found_ways).items())):
            tied = [found[i][n] for n in numbers]
            own[i][numbers] = told_apart(tied)
        found_ways = ways(own, between)
        margin = min(margin, _margin(found_ways))
    best = found_ways[0]
    kept = [best, *_different(found_ways[1:])][:_KEPT]
    vertices = [
        _landmarks(shapes, hub, {i: found[i][n] for i, n in way.choice.items()}) for way in kept
    ]
    taken = [found[i][n] for i, n in best.choice.items()]
    if len(fixed) >= COMMON:
        # these tell where the maps go: limbs that are left say nothing against it
        taken = [replace(h, whole=True) for h in taken]
    sure = bool(margin > LEAST_MARGIN and all(h.good for h in taken))
    if sure and len(vertices[0]) >= COMMON:
        in_turn = counted("ends of limbs", others)
        vertices[0] = completed(vertices[0], len(fixed), meshes, hub, in_turn)
    scores = [way.total / len(others) for way in kept]
    return CollectionProposal(vertices, scores, margin, len(fixed), sure)


def _margin(found: Sequence[Way]) -> float:
    return found[1].behind if len(found) > 1 else np.inf


def _near(found: Sequence[Way]) -> dict[int, list[int]]:
    """Of members with near ties the numbers of the hypotheses that are nearly as good as the one
    taken, this one included."""
    near: dict[int, list[int]] = {}
    for way in found[1:]:
        if way.behind <= LEAST_MARGIN:
            i, n = way.turned
            near.setdefault(i, [found[0].choice[i]]).append(n)
    return near


def _different(found: Sequence[Way]) -> list[Way]:
    """Ways with different choices, least total first."""
    of_choice = {tuple(sorted(way.choice.items())): way for way in found}
    return sorted(of_choice.values(), key=lambda way: way.total)


def hub_of(shapes: Sequence[CoarseShape]) -> int:
    """The shape of which four tips make the least distorted domain: maps from it are the best."""
    return int(np.argmin([quick_scores(shape)[1].min() for shape in shapes]))


def _between(first: Hypothesis, second: Hypothesis) -> float:
    """The score, without energy, of the map between the targets of two maps of one source."""
    a, b = first.candidate, second.candidate
    samples = a.source.shape.samples
    return compared(a.target.shape, a.images(samples), b.target.shape, b.images(samples))


def _landmarks(shapes: Sequence[CoarseShape], hub: int, taken: dict[int, Hypothesis]) -> np.ndarray:
    """Landmarks (L, k): given ones, and the hub's tips that correspond to tips of all others.

    Where these are fewer than four, tips come in that correspond to those of most others; on the
    rest they are where the map takes them.
    """
    tips = {i: dict(h.vertices.tolist()) for i, h in taken.items()}
    every = list(dict.fromkeys(v for pairs in tips.values() for v in pairs))
    every.sort(key=lambda v: -sum(v in pairs for pairs in tips.values()))  # stable
    given = [int(v) for v in shapes[hub].ids[shapes[hub].fixed]]
    rows: list[list[int]] = []
    for v in [*given, *(v for v in every if v not in given)]:
        if not all(v in pairs for pairs in tips.values()) and len(rows) >= LEAST_LANDMARKS:
            break
        row = [v] * len(shapes)
        for i, h in taken.items():
            local = np.searchsorted(shapes[hub].ids, [v])
            row[i] = tips[i].get(v, int(shapes[i].ids[h.candidate.images(local)[0]]))
        if all(row[i] != other[i] for other in rows for i in range(len(shapes))):
            rows.append(row)
    return np.array(rows, dtype=np.int64).reshape(-1, len(shapes))
