"""Landmarks judged by coarse maps, before any training: what would make the map less distorted?

All landmarks are drawn to their places by a coarse map. The same map without one of them, with two
exchanged, or with the orientation turned around tells by its energy which change the shapes want.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape, coarse_shape
from nsm.correspondence.layouts import Layout, Table, affine_maps, layout, quick_scores, table
from nsm.correspondence.search import Candidate, Round, trained
from nsm.errors import NsmError
from nsm.stages import counted, part
from nsm.wording import number_of

FEWEST = 4  # landmarks, at the cones
_FACES = 500
_SPREAD = 6  # landmarks among which the four at the cones are chosen
_ROUND = Round(0, 5, 30)
_EXCHANGED = 8  # landmarks at most of which two are exchanged: pairs are many
_STRAINED = 10.0  # energy of a strained map: then more is left out
_ASTRAY = 12.0  # energy from which on a map may be of a wrong isotopy class: other cones are tried
_GOOD = 7.0  # energy below which the map needs no change, whatever distances between landmarks say
_SETS = 12  # sets of four at the cones that are tried, until a map is good
_TOGETHER = 4  # sets that are tried at once
_BETTER = 0.8  # share of the energy with the first set, from which on another one is taken
# energies from which on landmarks are doubted as a whole; few are on like shapes met with less
_FEW, _STRAINED_FEW, _STRAINED_MANY = 5, 16.0, 30.0
# gains from which on a change is told. Measured, see docs/correspondence.md

Kind = Literal["mirrored", "exchanged", "wrong"]
_LEAST: dict[Kind, float] = {"mirrored": 0.25, "exchanged": 0.25, "wrong": 0.45}


class Change(NamedTuple):
    """A change of the landmarks, and what it gains.

    Attributes:
        kind: ``mirrored``: all sides are exchanged, or a surface is inside out; ``exchanged``: two
            landmarks; ``wrong``: one is left out.
        landmarks: their numbers; none for ``mirrored``.
        gain: log ratio of the energies before and after.
    """

    kind: Kind
    landmarks: tuple[int, ...]
    gain: float

    @property
    def excess(self) -> float:
        """By how much the gain is above the least that is told; negative below it."""
        return self.gain - _LEAST[self.kind]


@dataclass(frozen=True)
class CoarseCheck:
    """What coarse maps say of landmarks.

    Attributes:
        energy: mean symmetric Dirichlet energy of the map that meets all of them.
        changes: those that were tried.
        count: of the landmarks.
        cones: four landmarks for the cones, where the map is much less distorted with these than
            with those of which the surfaces' own layouts are distorted least; None elsewhere.
    """

    energy: float
    changes: list[Change]
    count: int
    cones: tuple[int, ...] | None = None

    @property
    def best(self) -> Change | None:
        """The change that the shapes want most; None if none gains enough."""
        found = max(self.changes, key=lambda change: change.excess, default=None)
        return found if found is not None and found.excess > 0 else None

    @property
    def good(self) -> bool:
        """Whether the map through all landmarks is as little distorted as those of like shapes."""
        return self.energy < _GOOD and self.best is None

    @property
    def strained(self) -> bool:
        """Whether the map through all landmarks is more distorted than those of like shapes."""
        return self.energy > (_STRAINED_FEW if self.count <= _FEW else _STRAINED_MANY)

    @property
    def explained(self) -> bool:
        """Whether the best change leaves a map that is little distorted."""
        return self.best is not None and self.energy * np.exp(-self.best.gain) < _STRAINED

    def numbered(self, numbers: np.ndarray) -> CoarseCheck:
        """The same for landmarks (L,) of a longer list, by their numbers in it."""
        changes = [
            change._replace(landmarks=tuple(numbers[list(change.landmarks)].tolist()))
            for change in self.changes
        ]
        cones = None if self.cones is None else tuple(numbers[list(self.cones)].tolist())
        return CoarseCheck(self.energy, changes, self.count, cones)


def coarse_check(
    source: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    landmarks: tuple[np.ndarray, np.ndarray],
) -> CoarseCheck | None:
    """Judge landmarks of two closed surfaces of genus 0 by coarse maps, within seconds.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        landmarks: vertices (L,) of both.

    Returns:
        None for other surfaces, for fewer than four landmarks, and where no four lie far enough
        apart.
    """
    ours, theirs = (np.asarray(ids, dtype=np.int64) for ids in landmarks)
    if len(ours) < FEWEST:
        return None
    try:
        maps = _Maps(
            coarse_shape(*source, tips=ours, count=_FACES),
            coarse_shape(*target, tips=theirs, count=_FACES),
        )
        return maps.check()
    except NsmError:  # another topology, or too many digits
        return None


class _Trial(NamedTuple):
    """A map to be trained: its change, where landmarks (L,) go, which (K,) are drawn there."""

    change: tuple[Kind, tuple[int, ...]] | None
    order: np.ndarray
    kept: np.ndarray


class _Maps:
    """Coarse maps of two shapes whose tips are the landmarks."""

    def __init__(self, source: CoarseShape, target: CoarseShape) -> None:
        self.source, self.target = source, target
        self.count = len(source.tips)
        spread = source.spread_tips(_SPREAD)
        self.sets, first = quick_scores(source, np.sort(spread))
        scores = first + quick_scores(target, np.sort(spread))[1]
        self.sets = self.sets[np.argsort(scores)]
        self.laid_out: dict[bytes, tuple[Layout, Layout, Table] | None] = {}

    def check(self) -> CoarseCheck | None:
        four, cones = self.sets[0], None
        found = self._trials(four)
        if found is None:
            return None
        if found[1][0] > _ASTRAY:
            # cones tell the isotopy classes that are tried; the right one may not be among these
            with part("strongly distorted"):
                other = self._better(found[1][0])
            changed = None if other is None else self._trials(other)
            if other is not None and changed is not None:
                four, found, cones = other, changed, tuple(other.tolist())
        trials, energies = found
        before = energies[0]
        changes = _changes(before, trials[1:], energies[1:])
        if before > _STRAINED:
            changes += self._without_cones(before, four)
            changes += self._worst_exchanged(before, changes)
        return CoarseCheck(before, changes, self.count, cones)

    def _trials(self, four: np.ndarray) -> tuple[list[_Trial], list[float]] | None:
        """The map through all landmarks, first, and the changes, with cones at four landmarks."""
        everything = np.arange(self.count)
        free = np.setdiff1d(everything, four)
        trials = [self._through_all, _Trial(("mirrored", ()), everything, everything)]
        trials += [self._without(k) for k in free.tolist()]
        if self.count <= _EXCHANGED:
            trials += list(self._exchanges(four))
        energies = self._energies(four, trials)
        return None if energies is None else (trials, energies)

    @property
    def _through_all(self) -> _Trial:
        everything = np.arange(self.count)
        return _Trial(None, everything, everything)

    def _better(self, energy: float) -> np.ndarray | None:
        """The four landmarks (4,) for the cones with which the map through all of them is much less
        distorted than with the first set; None if there are none."""
        best, found = _BETTER * energy, None
        for k in counted("other cones", range(1, _SETS, _TOGETHER)):
            sets = list(self.sets[k : min(k + _TOGETHER, _SETS)])
            every = self._all_energies([(four, [self._through_all]) for four in sets])
            for four, energies in zip(sets, every, strict=True):
                if energies is not None and energies[0] < best:
                    best, found = energies[0], four
            if best < _GOOD:
                break
        return found

    def _without(self, k: int) -> _Trial:
        everything = np.arange(self.count)
        return _Trial(("wrong", (k,)), everything, np.delete(everything, k))

    def _exchanges(self, four: np.ndarray) -> Iterator[_Trial]:
        """Two landmarks exchanged, of which both or none are cones."""
        for i, j in combinations(range(self.count), 2):
            if (i in four) == (j in four):
                yield self._exchange(i, j)

    def _exchange(self, i: int, j: int) -> _Trial:
        everything = np.arange(self.count)
        order = everything.copy()
        order[[i, j]] = j, i
        return _Trial(("exchanged", (i, j)), order, everything)

    def _worst_exchanged(self, before: float, changes: list[Change]) -> list[Change]:
        """The two landmarks without which the map is best, exchanged, if they were not yet."""
        without = sorted((c for c in changes if c.kind == "wrong"), key=lambda c: -c.gain)
        two = tuple(sorted(c.landmarks[0] for c in without[:2]))
        tried = {c.landmarks for c in changes}
        cones = [four for four in self.sets if np.isin(two, four).sum() != 1]
        if len(two) < 2 or two in tried or not cones:
            return []
        trials = [self._exchange(*two)]
        energies = self._energies(cones[0], trials)
        return [] if energies is None else _changes(before, trials, energies)

    def _without_cones(self, before: float, four: np.ndarray) -> list[Change]:
        """The landmarks at the cones left out, one by one, with few other sets of cones."""
        left, changes = set(four.tolist()), []
        while left:
            lacking = [len(left - set(other.tolist())) for other in self.sets]
            if not max(lacking):
                break
            other = self.sets[int(np.argmax(lacking))]
            out = left - set(other.tolist())
            trials = [self._without(k) for k in sorted(out)]
            energies = self._energies(other, trials)
            if energies is not None:
                changes += _changes(before, trials, energies)
            left -= out
        return changes

    def _energies(self, four: np.ndarray, trials: list[_Trial]) -> list[float] | None:
        """The least energies of trials over isotopy classes, with cones at four landmarks."""
        return self._all_energies([(four, trials)])[0]

    def _all_energies(
        self, wanted: Sequence[tuple[np.ndarray, list[_Trial]]]
    ) -> list[list[float] | None]:
        """The same for several fours, each with its trials: None where there is no layout."""
        number, found, drawn = [], [], []
        best: list[list[float] | None] = []
        for n, (four, trials) in enumerate(wanted):
            layouts = self._layouts(four)
            best.append(None if layouts is None else [np.inf] * len(trials))
            if layouts is None:
                continue
            ways = {det: _starts(*layouts, det) for det in (1, -1)}
            for k, trial in enumerate(trials):
                mirrored = trial.change is not None and trial.change[0] == "mirrored"
                pairs = np.stack([self.source.tips, self.target.tips[trial.order]], axis=1)
                cones = np.stack([four, trial.order[four]], axis=1)
                for candidate in ways[-1 if mirrored else 1]:
                    if np.array_equal(candidate.cone_numbers(), cones):
                        number.append((n, k))
                        found.append(candidate)
                        drawn.append(pairs[trial.kept])
        with part(number_of(len(found), "map")):
            after = trained(found, _ROUND, drawn=drawn)
        for (n, k), candidate in zip(number, after, strict=True):
            of_four = best[n]
            assert of_four is not None
            of_four[k] = min(of_four[k], candidate.energy)
        return best

    def _layouts(self, four: np.ndarray) -> tuple[Layout, Layout, Table] | None:
        """Both shapes laid out with cones at four landmarks, and the target's table."""
        key = four.tobytes()
        if key not in self.laid_out:
            a, b = layout(self.source, four), layout(self.target, four)
            self.laid_out[key] = None if a is None or b is None else (a, b, table(b))
        return self.laid_out[key]


def _starts(a: Layout, b: Layout, looked_up: Table, determinant: int) -> list[Candidate]:
    return [
        Candidate(a, b, looked_up, matrix, shift, 0, np.zeros((0, 2)), 0.0)
        for matrix, shift in affine_maps(a, b, determinant)
    ]


def _changes(before: float, trials: Iterable[_Trial], energies: Iterable[float]) -> list[Change]:
    return [
        Change(*trial.change, float(np.log(before / energy)))
        for trial, energy in zip(trials, energies, strict=True)
        if trial.change is not None
    ]
