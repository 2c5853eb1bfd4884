"""Samples of several surfaces in their common domain."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import pytorch_lightning as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from nsm.data.sampler import Draws, Sampler
from nsm.data.sampling import SurfaceSampler
from nsm.data.shard import Shard
from nsm.data.surface import HELD_OUT_BATCH, HELD_OUT_SEED, Steps, ready
from nsm.domains import Surface
from nsm.maps import LatticeAligned, Rotated
from nsm.settings import Count


class CollectionData(pl.LightningDataModule):
    """Points (N, 2) of the common domain, equally many by area of each surface.

    Args:
        surfaces: the prepared surfaces.
        starts: where each h_i starts; their inverses take points of the surfaces' domains to the
            common one.
        sampler: draws the training samples of each surface; a pool is drawn for each.
        batch_size: points in a step, of all surfaces together.
        steps_per_epoch: steps between two evaluations of the held-out points.
        held_out: points on which the distortion is followed; never trained on.
        seed: of the training samples.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        starts: Sequence[Rotated | LatticeAligned],
        sampler: Draws | None = None,
        *,
        batch_size: Count,
        steps_per_epoch: Count,
        held_out: Count,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.surfaces, self.starts, self.sampler = surfaces, starts, sampler or Sampler()
        self.share = max(1, batch_size // len(surfaces))
        self.held_share = max(1, held_out // len(surfaces))
        self.steps_per_epoch, self.seed = steps_per_epoch, seed
        self.part = Shard()

    def setup(self, stage: str | None = None) -> None:
        device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
        self.part = Shard.of(self.trainer)
        self.points = [SurfaceSampler(surface, device) for surface in self.surfaces]
        self.own_samplers = [ready(self.sampler, points, self.seed) for points in self.points]
        # copies: those of the task stay where they are
        self.starts = [copy.deepcopy(start).to(device) for start in self.starts]

    def batch(self, step: int) -> Tensor:
        """The training samples (N, 2) of a step; of several processes, this one's share of them."""
        # one stream for all: the samples of the surfaces are independent
        generator = self.points[0].generator(self.seed, step)
        parts = [
            start.back(sampler.draw(points, self.share, generator).uv)
            for sampler, points, start in zip(
                self.own_samplers, self.points, self.starts, strict=True
            )
        ]
        return self.part.of_rows(torch.cat(parts))

    def train_dataloader(self) -> DataLoader[Tensor]:
        return Steps.following(self.trainer, self.batch, self.steps_per_epoch)

    def val_dataloader(self) -> DataLoader[Tensor]:
        generator = self.points[0].generator(HELD_OUT_SEED, 0)
        parts = [
            start.back(points.by_area(self.held_share, generator).uv)
            for points, start in zip(self.points, self.starts, strict=True)
        ]
        return DataLoader(list(torch.cat(parts).split(HELD_OUT_BATCH)), batch_size=None)  # type: ignore[arg-type]
