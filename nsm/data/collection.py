"""Samples of several surfaces at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytorch_lightning as pl
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from nsm.data.overfit import HELD_OUT_SEED, Steps
from nsm.data.sampling import SurfaceSampler
from nsm.data.shard import Shard
from nsm.domains import Surface


class CollectionData(pl.LightningDataModule):
    """Points (N, 2) of the common domain, equally many by area of each surface.

    Args:
        surfaces: the prepared surfaces.
        turns: (k, 2, 2) rotations from the common domain to that of each surface.
        batch_size: points a step, of all surfaces together.
        steps_per_epoch: steps between two looks at the held-out points.
        vertex_share, domain_share: shares of a batch that are mesh vertices, and that are uniform
            in the domain, not by area; in [0, 1], their sum too.
        held_out: points on which the distortion is followed; never trained on.
        pool: not used; the paper draws afresh for maps.
        seed: of the training samples.
    """

    def __init__(
        self,
        surfaces: Sequence[Surface],
        turns: Tensor,
        *,
        batch_size: int,
        steps_per_epoch: int,
        vertex_share: float,
        held_out: int,
        domain_share: float = 0.0,
        pool: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.surfaces, self.turns = surfaces, turns
        self.share = max(1, batch_size // len(surfaces))
        self.held_share = max(1, held_out // len(surfaces))
        self.steps_per_epoch, self.seed = steps_per_epoch, seed
        self.shares = {"vertex_share": vertex_share, "domain_share": domain_share}
        self.part = Shard()

    def setup(self, stage: str | None = None) -> None:
        device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
        self.part = Shard.of(self.trainer)
        self.samplers = [SurfaceSampler(surface, device) for surface in self.surfaces]
        self.turns = self.turns.to(device)

    def batch(self, step: int) -> Tensor:
        """The training samples (N, 2) of a step; of several processes, this one's part of them."""
        return self.part.of_rows(self._drawn(self.share, self.shares, self.seed, step))

    def _drawn(self, count: int, shares: Mapping[str, float], seed: int, step: int) -> Tensor:
        # one stream for all: the samples of the surfaces are independent
        generator = self.samplers[0].generator(seed, step)
        parts = [
            sampler.draw(count, generator=generator, **shares).uv @ turn  # R⁻¹ = Rᵀ
            for sampler, turn in zip(self.samplers, self.turns, strict=True)
        ]
        return torch.cat(parts)

    def train_dataloader(self) -> DataLoader[Tensor]:
        return Steps.following(self.trainer, self.batch, self.steps_per_epoch)

    def val_dataloader(self) -> DataLoader[Tensor]:
        points = self._drawn(self.held_share, {"vertex_share": 0.0}, HELD_OUT_SEED, 0)
        return DataLoader(list(points.split(8192)), batch_size=None)  # type: ignore[arg-type]
