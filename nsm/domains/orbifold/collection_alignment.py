"""Isotopy classes for the maps of a collection, which compose: one class for each surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np

from nsm.domains.orbifold.alignment import Alignment, Judge, Landmarks, alignments
from nsm.domains.surface import Surface

_CHOICES = 3  # classes of each surface
_ROUNDS = 4
_BETTER = 1e-6


@dataclass(frozen=True)
class Disagreement:
    """A pair of a collection whose class is not the best for the pair alone.

    Attributes:
        source, target: numbers of the surfaces.
        composed: the map that follows from the others.
        own: the best alignment of the two.
    """

    source: int
    target: int
    composed: Alignment
    own: Alignment


def alignments_to_first(
    surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray] | None = None
) -> list[Alignment]:
    """An alignment of each surface of a collection to the first; the first's is the identity.

    The maps between any two surfaces follow from them. Of the likely classes of each surface those
    are taken for which the sum of the scores over all pairs is small: first the best to the first
    surface, then another wherever it lowers the sum.

    Args:
        surfaces: on the same closed domain.
        landmarks: corresponding vertices (L,) of each mesh file, if any; -1 for one that a mesh
            lacks.

    Raises:
        NsmError: as :func:`nsm.domains.orbifold.alignment.alignments`.
    """
    likely = [[Judge(surfaces[0], surfaces[0]).alignment(np.eye(2, dtype=np.int64), np.zeros(2))]]
    for k in range(1, len(surfaces)):
        common = _common(landmarks, k, 0)
        likely.append(alignments(surfaces[k], surfaces[0], common)[:_CHOICES])
    judges = {
        (i, j): Judge(surfaces[i], surfaces[j], _common(landmarks, i, j))
        for i, j in combinations(range(1, len(surfaces)), 2)
    }

    @cache
    def score(i: int, j: int, of_i: int, of_j: int) -> float:
        return judges[i, j].alignment(*likely[i][of_i].then(likely[j][of_j].inverse)).score

    def total(k: int, choice: int) -> float:
        """Of all pairs with surface k."""
        others = (
            score(k, j, choice, chosen[j]) if k < j else score(j, k, chosen[j], choice)
            for j in range(1, len(surfaces))
            if j != k
        )
        return likely[k][choice].score + sum(others)

    chosen = [0] * len(surfaces)
    for _ in range(_ROUNDS if len(surfaces) > 2 else 0):
        before = list(chosen)
        for k in range(1, len(surfaces)):
            totals = [total(k, choice) for choice in range(len(likely[k]))]
            if min(totals) < totals[chosen[k]] - _BETTER:
                chosen[k] = int(np.argmin(totals))
        if chosen == before:
            break
    return [likely[k][choice] for k, choice in enumerate(chosen)]


def disagreements(
    surfaces: Sequence[Surface],
    to_first: Sequence[Alignment],
    landmarks: Sequence[np.ndarray] | None = None,
) -> list[Disagreement]:
    """The pairs for which another class than the composed one has a lower score.

    Args:
        surfaces, landmarks: as for :func:`alignments_to_first`.
        to_first: what it returns.
    """
    found = []
    for i, j in combinations(range(len(surfaces)), 2):
        common = _common(landmarks, i, j)
        own = alignments(surfaces[i], surfaces[j], common)[0]
        matrix, shift = to_first[i].then(to_first[j].inverse)
        if _same_class(own, matrix, shift, surfaces[i]):
            continue
        composed = Judge(surfaces[i], surfaces[j], common).alignment(matrix, shift)
        if own.score < composed.score - _BETTER:
            found.append(Disagreement(i, j, composed, own))
    return found


def _common(landmarks: Sequence[np.ndarray] | None, i: int, j: int) -> Landmarks | None:
    """The landmarks that two surfaces have."""
    if landmarks is None:
        return None
    both = (landmarks[i] >= 0) & (landmarks[j] >= 0)
    return landmarks[i][both], landmarks[j][both]


def _same_class(one: Alignment, matrix: np.ndarray, shift: np.ndarray, surface: Surface) -> bool:
    same = np.array_equal(one.matrix, matrix)
    if not getattr(surface.domain, "even", False):
        return same  # translations of a torus do not change the class
    same = same or np.array_equal(one.matrix, -matrix)
    return bool(same and np.allclose(np.mod(one.shift - shift, 2), 0))
