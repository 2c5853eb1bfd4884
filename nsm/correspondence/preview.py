"""The coarse map that some landmarks give, within seconds: a check before the training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.correspondence.coarse_shape import coarse_shape
from nsm.correspondence.layouts import affine_maps, layout, quick_scores, table
from nsm.correspondence.search import NOTHING, Candidate, Round, trained
from nsm.errors import NsmError

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
    drawn: bool = False,
) -> Preview:
    """The coarse map of two closed surfaces of genus 0 through four of their landmarks.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        landmarks: vertices (L,) of both, four or more.
        drawn: whether the map is drawn to the other landmarks too, which then tell less of how well
            they fit.

    Raises:
        NsmError: ``too_few_landmarks``, ``wrong_topology``, or ``not_injective`` where four
            landmarks lie too close to each other.
    """
    ours, theirs = (np.asarray(ids, dtype=np.int64) for ids in landmarks)
    if len(ours) < 4:
        raise NsmError(
            f"{len(ours)} landmarks; a coarse map needs four",
            kind="too_few_landmarks",
            key="landmarks",
        )
    # both meshes keep all landmarks; the coarse shapes name them by their places among tips
    s, t = coarse_shape(*source, tips=ours), coarse_shape(*target, tips=theirs)
    most = s.spread_tips(_MOST)
    sets, first = quick_scores(s, most)
    second = quick_scores(t, most)[1]
    best = sets[int((first + second).argmin())]
    a, b = layout(s, best), layout(t, best)
    if a is None or b is None:
        raise NsmError(
            "the landmarks lie too close to each other for a coarse map",
            kind="not_injective",
            key="landmarks",
        )
    looked_up = table(b)
    nothing = np.zeros((0, 2))
    starts = [
        Candidate(a, b, looked_up, matrix, shift, 0, nothing, 0.0)
        for matrix, shift in affine_maps(a, b)
    ]
    wanted = np.stack([s.tips[best], t.tips[best]], axis=1)
    starts = [c for c in starts if np.array_equal(c.cones(), wanted)]
    held = np.stack([s.tips, t.tips], axis=1) if drawn else NOTHING
    found = trained(starts, _ROUND, held)
    off = [t.distance[c.images(s.tips), t.tips] for c in found]
    # the isotopy class that other landmarks tell, and distortion
    costs = [np.log(c.energy) + 4 * miss.mean() for c, miss in zip(found, off, strict=True)]
    k = int(np.argmin(costs))
    return Preview(found[k], best, found[k].energy, off[k])
