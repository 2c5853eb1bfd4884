"""Whether landmarks of surfaces fit each other, from distances alone: before any training."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsm.correspondence.distances import edge_distances

FEWEST = 5  # landmarks: three distances of a landmark say nothing of it
# of the distances to the others: below the first and above the second, a landmark is elsewhere.
# Measured on the animals, the cat and the horse and the busts, of five to all of their landmarks:
# right ones are doubted in 1 % of the choices, shuffled ones in 97 %
_RELATED, _SPREAD = 0.2, 0.25
_RELATED_ALL = 0.5


@dataclass(frozen=True)
class Agreement:
    """How distances between landmarks on one surface compare with those on the other.

    Attributes:
        correlation: of all distances; 1 for similar surfaces.
        each: (L,) correlation of a landmark's distances to the others; nan if it lacks some.
        spread: (L,) median of |log ratio| of these, the scale of the whole taken out.
    """

    correlation: float
    each: np.ndarray
    spread: np.ndarray

    @property
    def worst(self) -> int:
        """The number of the landmark that fits the others least."""
        return int(np.nanargmin(self.each))

    @property
    def doubtful(self) -> bool:
        """Whether a landmark, or all of them, are likely to be wrong."""
        apart = float(np.nanmedian(self.spread)) > _SPREAD
        one = (self.each < _RELATED) & (self.spread > _SPREAD)
        return bool(one.any()) or (self.correlation < _RELATED_ALL and apart)


@dataclass(frozen=True)
class CommonAgreement:
    """How the landmarks of several surfaces fit each other.

    Attributes:
        pairs: the agreement of surfaces i < j, where they have landmarks enough in common.
    """

    pairs: dict[tuple[int, int], Agreement]

    def of(self, surface: int) -> list[Agreement]:
        """The agreements of a surface with the others."""
        return [found for ends, found in self.pairs.items() if surface in ends]

    def correlation(self, surface: int) -> float:
        """Mean over the others of the correlation of distances."""
        return float(np.mean([found.correlation for found in self.of(surface)]))

    @property
    def worst(self) -> tuple[int, int]:
        """The surface that fits the others least, and the number of its worst landmark."""
        surfaces = sorted({k for ends in self.pairs for k in ends})
        doubts = {k: np.mean([found.doubtful for found in self.of(k)]) for k in surfaces}
        surface = min(surfaces, key=lambda k: (-doubts[k], self.correlation(k)))
        each = np.stack([found.each for found in self.of(surface)])
        known = np.isfinite(each).any(axis=0)
        mean = np.full(each.shape[1], np.inf)
        mean[known] = np.nanmean(each[:, known], axis=0)
        return surface, int(mean.argmin())

    @property
    def doubtful(self) -> bool:
        """Whether a surface disagrees with most of the others: one pair alone may be unlike."""
        own = self.of(self.worst[0])
        return sum(found.doubtful for found in own) > len(own) / 2

    @property
    def unrelated(self) -> bool:
        """Whether distances on the worst surface hardly go with those on the others."""
        return self.correlation(self.worst[0]) < _RELATED_ALL


def agreement(
    meshes: Sequence[tuple[np.ndarray, np.ndarray]], landmarks: Sequence[np.ndarray]
) -> CommonAgreement | None:
    """Compare the distances, along edges, between landmarks on meshes.

    Args:
        meshes: vertices (V, 3) and faces (F, 3) of two or more.
        landmarks: vertices (L,) of each; negative ones are missing.

    Returns:
        None if no two meshes have five landmarks in common.
    """
    apart = [_distances(*mesh, ids) for mesh, ids in zip(meshes, landmarks, strict=True)]
    pairs = {}
    for i, j in itertools.combinations(range(len(meshes)), 2):
        found = _compared(apart[i], apart[j])
        if found is not None:
            pairs[i, j] = found
    return CommonAgreement(pairs) if pairs else None


def _distances(vertices: np.ndarray, faces: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Between landmarks (L,), (L, L); nan for those that are missing."""
    apart = np.full((len(ids), len(ids)), np.nan)
    there = np.flatnonzero(ids >= 0)
    if len(there):
        apart[np.ix_(there, there)] = edge_distances(vertices, faces, ids[there])[:, ids[there]]
    return apart


def _compared(first: np.ndarray, second: np.ndarray) -> Agreement | None:
    """The agreement of distances (L, L); None for fewer than five landmarks that both have."""
    both = ~np.isnan(np.diagonal(first) + np.diagonal(second))
    known = np.isfinite(first) & np.isfinite(second) & (first > 0) & (second > 0)
    if both.sum() < FEWEST or not known.any():
        return None
    ratio = np.full(first.shape, np.nan)
    ratio[known] = np.log(second[known] / first[known])
    ratio -= np.nanmedian(ratio)
    each, spread = np.full((2, len(first)), np.nan)
    for k in np.flatnonzero(both).tolist():
        others = known[k]
        if others.sum() >= FEWEST - 1:
            each[k] = _correlation(first[k, others], second[k, others])
            spread[k] = np.median(np.abs(ratio[k, others]))
    if np.isnan(each).all():
        return None
    return Agreement(_correlation(first[known], second[known]), each, spread)


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Of x and y (N,); 1 if either is constant, which tells nothing against it."""
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return 1.0
    return float(np.corrcoef(x, y)[0, 1])
