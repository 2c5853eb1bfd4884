"""The coarse map that some landmarks give, within seconds: a check before the training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.correspondence.coarse_shape import coarse_shape
from nsm.correspondence.search import Candidate, Round, through_four, trained
from nsm.errors import NsmError
from nsm.wording import number_of

_ROUND = Round(8, 8, 60)
_MOST = 8  # landmarks among which the four at the cones are chosen


@dataclass(frozen=True)
class Preview:
    """The coarse map through four of the landmarks.

    Attributes:
        candidate: the map.
        cones: (4,) numbers of the landmarks at the cones of the orbifold, which it meets.
        energy: mean symmetric Dirichlet energy; 4 at isometry.
        off: (L,) distance on the target from each landmark's image to its place, over √area. One
            far larger than the others tells a landmark that does not fit the four.
    """

    candidate: Candidate
    cones: np.ndarray
    energy: float
    off: np.ndarray


def previewed(
    source: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    landmarks: tuple[np.ndarray, np.ndarray],
) -> Preview:
    """The coarse map of two closed surfaces of genus 0 through four of their landmarks.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        landmarks: vertices (L,) of both, four or more.

    Raises:
        NsmError: ``too_few_landmarks``, ``wrong_topology``, or ``not_injective`` where four
            landmarks lie too close to each other.
    """
    ours, theirs = (np.asarray(ids, dtype=np.int64) for ids in landmarks)
    if len(ours) < 4:
        raise NsmError(
            f"{number_of(len(ours), 'landmark')}; a coarse map needs four",
            kind="too_few_landmarks",
            key="landmarks",
        )
    # both meshes keep all landmarks; the coarse shapes name them by their places among tips
    s, t = coarse_shape(*source, tips=ours), coarse_shape(*target, tips=theirs)
    starts = through_four(s, t, s.spread_tips(_MOST))
    found = trained(starts, _ROUND)
    off = [t.distance[c.images(s.tips), t.tips] for c in found]
    # the isotopy class that other landmarks tell, and distortion
    costs = [np.log(c.energy) + 4 * miss.mean() for c, miss in zip(found, off, strict=True)]
    k = int(np.argmin(costs))
    return Preview(found[k], found[k].source.tips, found[k].energy, off[k])
