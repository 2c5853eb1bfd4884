"""Training and held-out samples of one surface, or of several trained in one batch."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytorch_lightning as pl
import torch
from torch.utils.data import DataLoader, IterableDataset

from nsm.data.sampler import Draws, Sampler
from nsm.data.sampling import Samples, SurfaceSampler
from nsm.data.shard import Shard
from nsm.domains import Surface
from nsm.settings import Count

# Held-out points come from their own stream, whatever the training's seed.
HELD_OUT_SEED = 7_919
HELD_OUT_BATCH = 8192


class Steps(IterableDataset[Any]):
    """One epoch: the batches of consecutive steps, each a function of (seed, step)."""

    def __init__(
        self, draw: Callable[[int], Any], first_step: Callable[[], int], length: int
    ) -> None:
        self.draw, self.first_step, self.length = draw, first_step, length

    @classmethod
    def following(
        cls, trainer: pl.Trainer | None, draw: Callable[[int], Any], length: int
    ) -> DataLoader[Any]:
        """The next ``length`` batches of a trainer, wherever it stands when they are drawn."""
        assert trainer is not None
        return DataLoader(cls(draw, lambda: trainer.global_step, length), batch_size=None)

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Any]:
        first = self.first_step()
        for step in range(first, first + self.length):
            yield self.draw(step)


def ready(sampler: Draws, surface: SurfaceSampler, seed: int) -> Draws:
    """A copy of a sampler for one surface, with its pool, if it keeps one, drawn."""
    own = copy.copy(sampler)
    if hasattr(own, "setup"):
        own.setup(surface, seed)
    return own


class SurfaceData(pl.LightningDataModule):
    """Samples of a surface, drawn on the trainer's device.

    Args:
        surface: the prepared surface.
        sampler: draws the training samples (see :class:`nsm.data.Sampler`).
        batch_size: points in a step.
        steps_per_epoch: steps between two evaluations of the held-out points.
        held_out: points on which the error is followed; never trained on.
        seed: of the training samples.
    """

    def __init__(
        self,
        surface: Surface,
        sampler: Draws | None = None,
        *,
        batch_size: Count = 4096,
        steps_per_epoch: Count = 250,
        held_out: Count = 16_384,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.surface, self.sampler = surface, sampler or Sampler()
        self.batch_size, self.steps_per_epoch = batch_size, steps_per_epoch
        self.held_out, self.seed = held_out, seed
        self.part = Shard()

    def setup(self, stage: str | None = None) -> None:
        device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
        self.part = Shard.of(self.trainer)
        self.points = SurfaceSampler(self.surface, device)
        self.own_sampler = ready(self.sampler, self.points, self.seed)

    def batch(self, step: int) -> Samples:
        """The training samples of a step; of several processes, this one's share of them."""
        generator = self.points.generator(self.seed, step)
        whole = self.own_sampler.draw(self.points, self.batch_size, generator)
        return Samples(*(self.part.of_rows(rows) for rows in whole))

    def train_dataloader(self) -> DataLoader[Samples]:
        return Steps.following(self.trainer, self.batch, self.steps_per_epoch)

    def held_out_batches(self) -> list[Samples]:
        """The held-out samples, in batches that are evaluated at once."""
        samples = self.points.by_area(self.held_out, self.points.generator(HELD_OUT_SEED))
        parts = zip(*(p.split(HELD_OUT_BATCH) for p in samples), strict=True)
        return [Samples(*part) for part in parts]

    def val_dataloader(self) -> DataLoader[Samples]:
        return DataLoader(self.held_out_batches(), batch_size=None)  # type: ignore[arg-type]


class EnsembleData(pl.LightningDataModule):
    """The samples that :class:`SurfaceData` has of each of k surfaces: Samples of (k, N, ...).

    Args:
        surfaces: the prepared surfaces; one may be there more than once.
        sampler: as for :class:`SurfaceData`.
        seeds: of the training samples, one for each. What is the same is drawn once.
        steps_per_epoch: steps between two evaluations of the held-out points.
        **settings: as for :class:`SurfaceData`.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        sampler: Draws,
        seeds: Sequence[int],
        *,
        steps_per_epoch: Count,
        **settings: Any,
    ) -> None:
        super().__init__()
        keys = list(zip(map(id, surfaces), seeds, strict=True))
        distinct = dict(zip(keys, surfaces, strict=True))
        self.parts = [
            SurfaceData(surface, sampler, seed=seed, **settings)
            for (_, seed), surface in distinct.items()
        ]
        self.order = [list(distinct).index(key) for key in keys]
        self.steps_per_epoch = steps_per_epoch

    def setup(self, stage: str | None = None) -> None:
        for part in self.parts:
            part.trainer = self.trainer
            part.setup(stage)

    def batch(self, step: int) -> Samples:
        """The training samples of a step."""
        return self._stacked([part.batch(step) for part in self.parts])

    def train_dataloader(self) -> DataLoader[Samples]:
        return Steps.following(self.trainer, self.batch, self.steps_per_epoch)

    def val_dataloader(self) -> DataLoader[Samples]:
        each = zip(*(part.held_out_batches() for part in self.parts), strict=True)
        return DataLoader([self._stacked(batches) for batches in each], batch_size=None)  # type: ignore[arg-type]

    def _stacked(self, samples: Sequence[Samples]) -> Samples:
        each = zip(*(samples[i] for i in self.order), strict=True)
        return Samples(*(torch.stack(same) for same in each))
