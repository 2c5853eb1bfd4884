"""The terms of a loss, and distortion at samples."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nsm.energies import Blend

Term = tuple[float | Tensor, Tensor]


@dataclass(frozen=True)
class Distortion:
    """A blend of energies at samples.

    Attributes:
        blend: the energies and their weights.
        parts: each energy by name, without its weight, (..., N).
        share: what each sample counts, (..., N); None: all alike.
    """

    blend: Blend
    parts: dict[str, Tensor]
    share: Tensor | None = None

    def _mean(self, values: Tensor) -> Tensor:
        if self.share is None:
            return values.sum() / mean_of_processes(values.new_tensor(max(1, values.numel())))
        weight = mean_of_processes(self.share.sum(dim=-1)).clamp(min=1e-12)
        return ((self.share * values).sum(dim=-1) / weight).mean()

    @property
    def terms(self) -> dict[str, Term]:
        """The mean of each energy with its weight, as terms of a loss."""
        weights = self.blend.weights
        return {f"distortion_{n}": (weights[n], self._mean(v)) for n, v in self.parts.items()}

    @property
    def values(self) -> Tensor:
        """The blend at each sample, (..., N)."""
        return self.blend.total(self.parts)

    @property
    def mean(self) -> Tensor:
        """The mean of the blend, zero if there are no samples."""
        return self._mean(self.values)


def mean_of_processes(amount: Tensor) -> Tensor:
    """The mean of what each process of a training has, without a gradient.

    Gradients are averaged over the processes: a sum over a process's samples, divided by this mean
    of their weights, counts for the mean over all samples.
    """
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return amount
    total = amount.detach().clone()
    torch.distributed.all_reduce(total)
    return total / torch.distributed.get_world_size()


class HeldOut:
    """Distortion at held-out points, gathered over the batches of one look at them."""

    def __init__(self) -> None:
        self._values: list[Tensor] = []
        self._shares: list[Tensor] = []

    def add(self, distortion: Distortion) -> None:
        """Take in a batch."""
        values, share = distortion.values.detach(), distortion.share
        self._values.append(values.flatten())
        self._shares.append((torch.ones_like(values) if share is None else share).flatten())

    def median(self) -> Tensor:
        """The least value with half of the weight at or below it; forgets what it was made of."""
        values, order = torch.cat(self._values).sort()
        weight = torch.cat(self._shares)[order].double().cumsum(dim=0)
        self._values, self._shares = [], []
        middle = int(torch.searchsorted(weight, 0.5 * weight[-1])) if len(values) else 0
        return values[min(middle, len(values) - 1)] if len(values) else values.new_tensor(torch.nan)
