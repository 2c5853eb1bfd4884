"""Tips that a map leaves apart are drawn together, and let go again.

A limb whose tip is no cone may end on another part of the target. No small change of the map lowers
the energy there: every point between would first be stretched. Where the map is better after it was
drawn past them, that map is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from nsm.correspondence.scores import score
from nsm.correspondence.search import Candidate, Round, fixed_pairs, trained

MENDING = (Round(16, 8, 40), Round(16, 12, 40))


def mended(found: Sequence[Candidate], one: Round) -> list[Candidate]:
    """The best candidates, mended where that lowers their scores, best first.

    Args:
        found: trained candidates.
        one: how many of them are mended, and how.
    """
    kept = sorted(found, key=score)[: one.maps]
    drawn = [np.concatenate([fixed_pairs(c), left_apart(c)]) for c in kept]
    freed = trained(trained(kept, one, drawn=drawn), one, held=True)
    return sorted((min(pair, key=score) for pair in zip(kept, freed, strict=True)), key=score)


def left_apart(candidate: Candidate) -> np.ndarray:
    """Tips (L, 2) of both shapes that are neither cones nor given, in pairs.

    The pairs have the least sum of distances from the tips' images to the tips of the target.
    """
    source, target = candidate.source.shape, candidate.target.shape
    cones = candidate.cones()
    ours = np.setdiff1d(source.free_peaks(), cones[:, 0])
    theirs = np.setdiff1d(target.free_peaks(), cones[:, 1])
    apart = target.distance[np.ix_(candidate.images(ours), theirs)]
    rows, columns = linear_sum_assignment(apart)
    return np.stack([ours[rows], theirs[columns]], axis=1)
