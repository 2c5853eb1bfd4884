"""The terms of a loss: distortion at samples, and a user's own."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from nsm.energies import Blend
from nsm.errors import NsmError
from nsm.instantiation import made

Term = tuple[float | Tensor, Tensor | float]  # weight and value; a term that is absent is 0.0


@dataclass(frozen=True)
class Evaluation:
    """What a user's own loss term sees of a step, at N samples (of a collection: (k, N)).

    Attributes:
        uv: (N, 2) points of Ω.
        position: (N, 3) points of the surface there.
        image: what the trained map makes of uv: φ (N, 3) for overfit, h (N, 2) for all others.
        source: (N, 2, 2) metric A of the source; None for overfit.
        target: (N, 2, 2) metric B of the image; None for a collection, whose targets are many.
        determinant: (N,) det J_h; None for overfit.
        share: (N,) of the area, where the places are triangles: uv and the others are those of
            their centres, metrics in the frames of their first two sides; None: samples.
    """

    uv: Tensor
    position: Tensor
    image: Tensor
    source: Tensor | None = None
    target: Tensor | None = None
    determinant: Tensor = None  # type: ignore[assignment]
    share: Tensor | None = None


class LossTerm(nn.Module):
    """A user's own loss term: from an :class:`Evaluation` to values (N,) or a scalar.

    Args:
        function: the term; if it is a module, it moves to the training's device.
        weight: its weight in the loss.
    """

    def __init__(self, function: Callable[[Evaluation], Tensor], weight: float) -> None:
        super().__init__()
        self.function, self.weight = function, weight

    def forward(self, evaluation: Evaluation) -> Tensor:
        """The mean of the term over the samples, a scalar."""
        return self.function(evaluation).mean()


def made_terms(settings: Mapping[str, Mapping[str, Any]]) -> nn.ModuleDict:
    """The user's own terms by name.

    Args:
        settings: by name, ``_target_`` and its parameters, and ``weight`` (1 by default).

    Raises:
        NsmError: a term that cannot be made.
    """
    terms = nn.ModuleDict()
    for name, given in settings.items():
        rest = dict(given)
        weight = rest.pop("weight", 1.0)
        function = made(rest)
        if not callable(function):
            raise NsmError(
                f"setting loss_terms.{name}: it is not callable with an Evaluation",
                kind="wrong_type",
                key=f"loss_terms.{name}",
            )
        terms[name] = LossTerm(function, float(weight))
    return terms


def as_blend(energy: Any) -> Blend:
    """An energy as a blend of one, under its class's name in lower case: symmetric_dirichlet."""
    if isinstance(energy, Blend):
        return energy
    name = getattr(energy, "__name__", type(energy).__name__)
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return Blend(weights={name: 1.0}, terms={name: energy})


@dataclass(frozen=True)
class Distortion:
    """A blend of energies at samples.

    Attributes:
        blend: the energies and their weights.
        parts: each energy by name, without its weight, (..., N).
        share: the weight of each sample, (..., N); None: all equal.
    """

    blend: Blend
    parts: dict[str, Tensor]
    share: Tensor | None = None

    def _mean(self, values: Tensor) -> Tensor:
        if self.share is None:
            return values.sum() / mean_of_processes(values.new_full((), max(1, values.numel())))
        return self._means(values, self.share).mean()

    @staticmethod
    def _means(values: Tensor, share: Tensor) -> Tensor:
        weight = mean_of_processes(share.sum(dim=-1)).clamp(min=1e-12)
        return (share * values).sum(dim=-1) / weight

    @property
    def terms(self) -> dict[str, Term]:
        """The mean of each energy with its weight."""
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

    @property
    def means(self) -> Tensor:
        """The mean of the blend over the samples of each map (...)."""
        values = self.values
        return self._means(values, torch.ones_like(values) if self.share is None else self.share)


def mean_of_processes(amount: Tensor) -> Tensor:
    """The mean of an amount over the processes of a training, without a gradient.

    Gradients are averaged over the processes: a sum over a process's samples, divided by this mean
    of their weights, counts for the mean over all samples.
    """
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return amount
    total = amount.detach().clone()
    torch.distributed.all_reduce(total)
    return total / torch.distributed.get_world_size()


class HeldOut:
    """Distortion at held-out points, gathered over the batches of one validation."""

    def __init__(self) -> None:
        self._values: list[Tensor] = []
        self._shares: list[Tensor] = []

    def add(self, distortion: Distortion) -> None:
        """Add a batch."""
        values, share = distortion.values.detach(), distortion.share
        self._values.append(values.flatten())
        self._shares.append((torch.ones_like(values) if share is None else share).flatten())

    def median(self) -> Tensor:
        """The least value with half of the weight at or below it; the batches are dropped."""
        values, order = torch.cat(self._values).sort()
        weight = torch.cat(self._shares)[order].double().cumsum(dim=0)
        self._values, self._shares = [], []
        middle = int(torch.searchsorted(weight, 0.5 * weight[-1])) if len(values) else 0
        return values[min(middle, len(values) - 1)] if len(values) else values.new_tensor(torch.nan)
