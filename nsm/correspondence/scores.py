"""Scores of maps of two coarse shapes: what tells the right one from others."""

from __future__ import annotations

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape
from nsm.correspondence.search import Candidate, changes, missed, rigid_residual

# weights beside the logarithm of the energy
_DISTANCES, _RIGID, _MISSED = 4.0, 2.0, 4.0


def score(candidate: Candidate) -> float:
    """The score of a trained map; lower is better.

    log E + 4 d + 2 r + 4 m: E the mean symmetric Dirichlet energy; d the mean change of geodesic
    distances; r the root mean square distance after the best rigid motion; m the mean distance by
    which the map misses given landmarks. All lengths over √area.
    """
    s, t = candidate.source.shape, candidate.target.shape
    value = float(np.log(candidate.energy))
    value += compared(s, s.samples, t, candidate.images(s.samples))
    return value + (_MISSED * float(missed(candidate).mean()) if s.given else 0.0)


def compared(
    source: CoarseShape, points: np.ndarray, target: CoarseShape, images: np.ndarray
) -> float:
    """The part of the score that corresponding vertices (N,) of two shapes tell alone."""
    change = changes(source, points, target, images)
    return _DISTANCES * float(change) + _RIGID * rigid_residual(source, points, target, images)
