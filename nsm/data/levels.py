"""One fixed batch for each level of a training that goes from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Generic, TypeVar

from torch import Tensor

from nsm.data.collection import CollectionData
from nsm.data.sampler import Draws
from nsm.data.sampling import Samples
from nsm.data.surface import SurfaceData
from nsm.domains import Surface
from nsm.maps import LatticeAligned, Rotated
from nsm.settings import Count

Batch = TypeVar("Batch")


class _Levels(Generic[Batch]):
    """The levels of a training, and the batch of the one that was drawn last.

    Args:
        points: in the batch of each level.
        steps: of each level but the last.

    Raises:
        ValueError: as many ``steps`` as ``points``, or more; or fewer by two.
    """

    def __init__(self, points: Sequence[int], steps: Sequence[int]) -> None:
        if len(steps) != len(points) - 1 or min(points, default=0) < 1 or min(steps, default=0) < 0:
            raise ValueError(
                "data.points has one number, 1 or more, per level; data.steps one, 0 or more, per "
                "level but the last"
            )
        self.counts, self.ends = list(points), list(accumulate(steps))
        self._drawn: tuple[int, Batch] | None = None

    def at(self, step: int, draw: Callable[[int, int], Batch]) -> Batch:
        """The batch of a step's level, which ``draw`` makes once of its number and its count."""
        level = sum(step >= end for end in self.ends)
        if self._drawn is None or self._drawn[0] != level:
            self._drawn = level, draw(level, self.counts[level])
        return self._drawn[1]


class LevelData(SurfaceData):
    """Samples of a surface that stay the same during a level: a fixed quadrature.

    Args:
        surface: the prepared surface.
        sampler: draws the training samples (see :class:`nsm.data.Sampler`).
        points: in the batch of each level.
        steps: of each level but the last, which lasts until the end.
        steps_per_epoch, held_out, seed: as for :class:`nsm.data.SurfaceData`.

    Raises:
        ValueError: as many ``steps`` as ``points``, or more; or fewer by two.
    """

    def __init__(
        self,
        surface: Surface,
        sampler: Draws | None = None,
        *,
        points: Sequence[int],
        steps: Sequence[int],
        steps_per_epoch: Count = 250,
        held_out: Count = 16_384,
        seed: int = 0,
    ) -> None:
        self.levels = _Levels[Samples](points, steps)
        super().__init__(
            surface,
            sampler,
            batch_size=points[-1],
            steps_per_epoch=steps_per_epoch,
            held_out=held_out,
            seed=seed,
        )

    def batch(self, step: int) -> Samples:
        """The samples of a step's level; of several processes, this one's share of them."""
        return self.levels.at(step, self._draw)

    def _draw(self, level: int, count: int) -> Samples:
        generator = self.points.generator(self.seed, level)
        whole = self.own_sampler.draw(self.points, count, generator)
        return Samples(*(self.part.of_rows(rows) for rows in whole))


class CollectionLevelData(CollectionData):
    """As :class:`LevelData`, samples of several surfaces in their common domain.

    Args:
        surfaces, starts, sampler: as for :class:`nsm.data.CollectionData`.
        points: in the batch of each level, of all surfaces together.
        steps: of each level but the last, which lasts until the end.
        steps_per_epoch, held_out, seed: as for :class:`nsm.data.CollectionData`.

    Raises:
        ValueError: as for :class:`LevelData`.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        starts: Sequence[Rotated | LatticeAligned],
        sampler: Draws | None = None,
        *,
        points: Sequence[int],
        steps: Sequence[int],
        steps_per_epoch: Count = 250,
        held_out: Count = 8192,
        seed: int = 0,
    ) -> None:
        self.levels = _Levels[Tensor](points, steps)
        super().__init__(
            surfaces,
            starts,
            sampler,
            batch_size=points[-1],
            steps_per_epoch=steps_per_epoch,
            held_out=held_out,
            seed=seed,
        )

    def batch(self, step: int) -> Tensor:
        """The samples (N, 2) of a step's level; of several processes, this one's share of them."""
        return self.levels.at(step, self._draw)

    def _draw(self, level: int, count: int) -> Tensor:
        self.share = max(1, count // len(self.surfaces))
        return super().batch(level)
