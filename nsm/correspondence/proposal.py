"""Correspondences of two closed surfaces without landmarks, and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape, coarse_shape
from nsm.correspondence.search import (
    Candidate,
    candidates,
    changes,
    missed,
    rigid_residual,
)

# weights beside the logarithm of the energy
_DISTANCES, _RIGID, _MISSED = 4.0, 2.0, 4.0
_DIFFERENT = 0.2  # mean distance of two maps' images, over √area, from which they are two
_KEPT = 5
_NEAR = 0.1  # of a tip's image to the tip that corresponds to it, over √area
_AROUND = 0.3  # a tip's neighbourhood, over √area
LEAST_MARGIN = 0.2
LARGEST_SCORE = 3.0
NONE = np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True)
class Hypothesis:
    """A correspondence that may be the right one.

    Attributes:
        vertices: (L, 2) corresponding vertices of source and target: landmarks that were given;
            the four at the cones of the orbifold; then other tips that the map brings near to each
            other.
        score: log energy + 4 distance_change + 2 rigid_residual + 4 missed; lower is better.
        energy: mean symmetric Dirichlet energy of the coarse map; 4 at isometry.
        distance_change: mean change of geodesic distances, over √area.
        rigid_residual: root mean square distance after the best rigid motion, over √area.
        missed: mean distance, over √area, by which the coarse map misses given landmarks.
        candidate: the coarse map.
    """

    vertices: np.ndarray
    score: float
    energy: float
    distance_change: float
    rigid_residual: float
    missed: float
    candidate: Candidate


@dataclass(frozen=True)
class Proposal:
    """Hypotheses that differ from each other, best first.

    Attributes:
        hypotheses: one or more.
        margin: by how much the score of the second is above that of the first.
        given: how many landmarks were given; they come first in each hypothesis.
    """

    hypotheses: list[Hypothesis]
    margin: float
    given: int = 0

    @property
    def sure(self) -> bool:
        """Whether the first is far ahead of the second, and good in itself."""
        return self.margin > LEAST_MARGIN and self.hypotheses[0].score < LARGEST_SCORE


def proposed(
    source: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    given: np.ndarray = NONE,
) -> Proposal:
    """Propose correspondences of two closed surfaces of genus 0, without reflections.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        given: (G, 2) corresponding vertices of both, up to four, which are kept and completed.

    Raises:
        NsmError: ``wrong_topology`` or ``no_proposal``, see
            :func:`nsm.correspondence.coarse_shape.coarse_shape` and
            :func:`nsm.correspondence.search.candidates`.
    """
    meshes = (source, target)
    kept = hypotheses(*(coarse_shape(*mesh, fixed=given[:, k]) for k, mesh in enumerate(meshes)))
    margin = kept[1].score - kept[0].score if len(kept) > 1 else np.inf
    return Proposal(kept, margin, len(given))


def hypotheses(source: CoarseShape, target: CoarseShape) -> list[Hypothesis]:
    """Correspondences of two coarse shapes that differ from each other, best first."""
    kept: list[Hypothesis] = []
    for hypothesis in sorted(map(_hypothesis, candidates(source, target)), key=lambda h: h.score):
        if len(kept) < _KEPT and all(_apart(hypothesis, other) > _DIFFERENT for other in kept):
            kept.append(hypothesis)
    return kept


def compared(
    source: CoarseShape, points: np.ndarray, target: CoarseShape, images: np.ndarray
) -> float:
    """The part of the score that corresponding vertices (N,) of two shapes tell alone."""
    change = changes(source, points, target, images)
    return _DISTANCES * float(change) + _RIGID * rigid_residual(source, points, target, images)


def _hypothesis(candidate: Candidate) -> Hypothesis:
    s, t = candidate.source.shape, candidate.target.shape
    images = candidate.images(s.samples)
    change = float(changes(s, s.samples, t, images))
    residual = rigid_residual(s, s.samples, t, images)
    off = float(missed(candidate).mean()) if candidate.source.shape.given else 0.0
    score = float(np.log(candidate.energy)) + _DISTANCES * change + _RIGID * residual
    score += _MISSED * off
    pairs = _matched_tips(candidate)
    ids = candidate.source.shape.ids[pairs[:, 0]], candidate.target.shape.ids[pairs[:, 1]]
    return Hypothesis(
        np.stack(ids, axis=1), score, candidate.energy, change, residual, off, candidate
    )


def _matched_tips(candidate: Candidate) -> np.ndarray:
    """Vertices (L, 2) of the coarse shapes: given landmarks, cones, and tips whose images are
    mutually nearest. None is near a given landmark, which says the same."""
    source, target = candidate.source.shape, candidate.target.shape
    pairs = _away(candidate, candidate.cones())
    ours = np.setdiff1d(_peaks(source), pairs[:, 0])
    theirs = np.setdiff1d(_peaks(target), pairs[:, 1])
    if len(ours) and len(theirs):
        apart = target.distance[np.ix_(candidate.images(ours), theirs)]
        nearest = apart.argmin(axis=1)
        rows = np.arange(len(ours))
        mutual = (apart.argmin(axis=0)[nearest] == rows) & (apart[rows, nearest] < _NEAR)
        more = np.stack([ours, theirs[nearest]], axis=1)[mutual]
        pairs = np.concatenate([pairs, _away(candidate, more)])
    return np.concatenate([np.stack([source.fixed, target.fixed], axis=1), pairs])


def _away(candidate: Candidate, pairs: np.ndarray) -> np.ndarray:
    """Those of pairs (L, 2) of which neither end is near a given landmark."""
    keep = np.ones(len(pairs), dtype=bool)
    for k, shape in enumerate((candidate.source.shape, candidate.target.shape)):
        apart = shape.distance[np.ix_(pairs[:, k], shape.fixed)]
        keep &= apart.min(axis=1, initial=np.inf) > _NEAR
    return pairs[keep]


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
