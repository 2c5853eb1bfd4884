"""Correspondences of two closed surfaces without landmarks, and how sure they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape, coarse_shape
from nsm.correspondence.search import Candidate, candidates, distance_change, rigid_residual

_DISTANCES, _RIGID = 4.0, 2.0  # weights beside the logarithm of the energy
_DIFFERENT = 0.2  # mean distance of two maps' images, over √area, from which they are two
_KEPT = 5
_NEAR = 0.1  # of a tip's image to the tip that corresponds to it, over √area
_AROUND = 0.3  # a tip's neighbourhood, over √area
_LEAST_MARGIN = 0.2
_LARGEST_SCORE = 3.0


@dataclass(frozen=True)
class Hypothesis:
    """A correspondence that may be the right one.

    Attributes:
        vertices: (L, 2) corresponding vertices of source and target: the four at the cones of the
            orbifold, then other tips that the map brings near to each other.
        score: log energy + 4 distance_change + 2 rigid_residual; lower is better.
        energy: mean symmetric Dirichlet energy of the coarse map; 4 at isometry.
        distance_change: mean change of geodesic distances, over √area.
        rigid_residual: root mean square distance after the best rigid motion, over √area.
        candidate: the coarse map.
    """

    vertices: np.ndarray
    score: float
    energy: float
    distance_change: float
    rigid_residual: float
    candidate: Candidate


@dataclass(frozen=True)
class Proposal:
    """Hypotheses that differ from each other, best first.

    Attributes:
        hypotheses: one or more.
        margin: by how much the score of the second is above that of the first.
    """

    hypotheses: list[Hypothesis]
    margin: float

    @property
    def sure(self) -> bool:
        """Whether the first is far ahead of the second, and good in itself."""
        return self.margin > _LEAST_MARGIN and self.hypotheses[0].score < _LARGEST_SCORE


def proposed(
    source: tuple[np.ndarray, np.ndarray], target: tuple[np.ndarray, np.ndarray]
) -> Proposal:
    """Propose correspondences of two closed surfaces of genus 0, without reflections.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).

    Raises:
        NsmError: ``wrong_topology`` or ``no_proposal``, see
            :func:`nsm.correspondence.coarse_shape.coarse_shape`.
    """
    found = candidates(coarse_shape(*source), coarse_shape(*target))
    kept: list[Hypothesis] = []
    for hypothesis in sorted(map(_hypothesis, found), key=lambda h: h.score):
        if len(kept) < _KEPT and all(_apart(hypothesis, other) > _DIFFERENT for other in kept):
            kept.append(hypothesis)
    margin = kept[1].score - kept[0].score if len(kept) > 1 else np.inf
    return Proposal(kept, margin)


def proposed_for_all(meshes: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Landmarks (L, k) of k closed meshes: those proposed for the first and each other one.

    Args:
        meshes: vertices (V, 3) and faces (F, 3) of each.

    Raises:
        NsmError: as :func:`proposed`.
    """
    pairs = [proposed(meshes[0], other).hypotheses[0].vertices for other in meshes[1:]]
    common = [v for v in pairs[0][:, 0] if all(v in found[:, 0] for found in pairs)]
    rows = [[v, *(found[found[:, 0] == v, 1][0] for found in pairs)] for v in common]
    return np.array(rows, dtype=np.int64).reshape(-1, len(meshes))


def _hypothesis(candidate: Candidate) -> Hypothesis:
    change, residual = distance_change(candidate), rigid_residual(candidate)
    score = float(np.log(candidate.cost)) + _DISTANCES * change + _RIGID * residual
    pairs = _matched_tips(candidate)
    ids = candidate.source.shape.ids[pairs[:, 0]], candidate.target.shape.ids[pairs[:, 1]]
    return Hypothesis(np.stack(ids, axis=1), score, candidate.cost, change, residual, candidate)


def _matched_tips(candidate: Candidate) -> np.ndarray:
    """Vertices (L, 2) of the coarse shapes: cones, and tips whose images are mutually nearest."""
    source, target = candidate.source.shape, candidate.target.shape
    pairs = candidate.cones()
    ours = np.setdiff1d(_peaks(source), pairs[:, 0])
    theirs = np.setdiff1d(_peaks(target), pairs[:, 1])
    if len(ours) and len(theirs):
        apart = target.distance[np.ix_(candidate.images(ours), theirs)]
        nearest = apart.argmin(axis=1)
        rows = np.arange(len(ours))
        mutual = (apart.argmin(axis=0)[nearest] == rows) & (apart[rows, nearest] < _NEAR)
        pairs = np.concatenate([pairs, np.stack([ours, theirs[nearest]], axis=1)[mutual]])
    return pairs


def _peaks(shape: CoarseShape) -> np.ndarray:
    """The tips from which the mean distance falls all around; others lie between limbs."""
    around = shape.distance[shape.tips] < _AROUND
    height = np.where(around, shape.mean_distance, 0.0).max(axis=1)
    return shape.tips[shape.mean_distance[shape.tips] >= height]


def _apart(first: Hypothesis, second: Hypothesis) -> float:
    """Mean distance of the images of samples under two maps."""
    shape = first.candidate.source.shape
    a, b = (h.candidate.images(shape.samples) for h in (first, second))
    return float(first.candidate.target.shape.distance[a, b].mean())
