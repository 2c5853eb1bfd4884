"""Training and held-out samples for overfitting one surface."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytorch_lightning as pl
import torch
from torch.utils.data import DataLoader, IterableDataset

from nsm.data.sampling import Samples, SurfaceSampler
from nsm.data.shard import Shard
from nsm.domains import Surface

# Held-out points come from their own stream, whatever the training's seed.
HELD_OUT_SEED = 7_919


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
        """The next ``length`` batches of a trainer, wherever it stands when they are wanted."""
        assert trainer is not None
        return DataLoader(cls(draw, lambda: trainer.global_step, length), batch_size=None)

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Any]:
        first = self.first_step()
        for step in range(first, first + self.length):
            yield self.draw(step)


class OverfitData(pl.LightningDataModule):
    """Samples of a surface, drawn on the trainer's device.

    Args:
        surface: the prepared surface.
        batch_size: points a step.
        steps_per_epoch: steps between two looks at the held-out points.
        vertex_share: share of a batch that are mesh vertices, in [0, 1].
        domain_share: share of a batch that is uniform in Ω, not by area; 1 with the vertices' at
            most. Errors are not weighted: it says how much each part of the surface counts.
        pool: None to draw afresh each step; a number for a fixed set of so many points (all
            vertices among them), as published, from which the batches are picked.
        held_out: points on which the error is followed; never trained on.
        seed: of the training samples.
    """

    def __init__(
        self,
        surface: Surface,
        *,
        batch_size: int = 4096,
        steps_per_epoch: int = 250,
        vertex_share: float = 0.1,
        domain_share: float = 0.0,
        pool: int | None = None,
        held_out: int = 16_384,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.surface = surface
        self.batch_size, self.steps_per_epoch = batch_size, steps_per_epoch
        self.vertex_share, self.domain_share, self.pool_size = vertex_share, domain_share, pool
        self.held_out, self.seed = held_out, seed
        self.part = Shard()

    def setup(self, stage: str | None = None) -> None:
        device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
        self.part = Shard.of(self.trainer)
        self.sampler = SurfaceSampler(self.surface, device)
        self.pool = (
            self.sampler.pool(self.pool_size, self.sampler.generator(self.seed, -1))
            if self.pool_size
            else None
        )

    def batch(self, step: int) -> Samples:
        """The training samples of a step; of several processes, this one's part of them."""
        return Samples(*(self.part.of_rows(rows) for rows in self._whole(step)))

    def _whole(self, step: int) -> Samples:
        generator = self.sampler.generator(self.seed, step)
        if self.pool is None:
            shares = {"vertex_share": self.vertex_share, "domain_share": self.domain_share}
            return self.sampler.draw(self.batch_size, generator=generator, **shares)
        index = torch.randint(
            len(self.pool.uv),
            (self.batch_size,),
            generator=generator,
            device=self.sampler.device,
        )
        return Samples(*(part[index] for part in self.pool))

    def train_dataloader(self) -> DataLoader[Samples]:
        return Steps.following(self.trainer, self.batch, self.steps_per_epoch)

    def held_out_batches(self) -> list[Samples]:
        """The held-out samples, so many at once as are evaluated together."""
        samples = self.sampler.by_area(self.held_out, self.sampler.generator(HELD_OUT_SEED))
        return [Samples(*parts) for parts in zip(*(p.split(8192) for p in samples), strict=True)]

    def val_dataloader(self) -> DataLoader[Samples]:
        return DataLoader(self.held_out_batches(), batch_size=None)  # type: ignore[arg-type]


class EnsembleData(pl.LightningDataModule):
    """The samples that :class:`OverfitData` has of each of k surfaces: Samples of (k, N, ...).

    Args:
        surfaces: the prepared surfaces; one may be there more than once.
        seeds: of the training samples, one for each. What is the same is drawn once.
        **settings: as for :class:`OverfitData`, with the steps between two looks at the held-out
            points.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        seeds: Sequence[int],
        *,
        steps_per_epoch: int,
        **settings: Any,
    ) -> None:
        super().__init__()
        asked = list(zip(map(id, surfaces), seeds, strict=True))
        known = dict(zip(asked, surfaces, strict=True))
        self.parts = [OverfitData(known[one], seed=one[1], **settings) for one in known]
        self.order = [list(known).index(one) for one in asked]
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
