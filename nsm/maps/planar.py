"""Planar maps h: Ω → R² that start as the identity."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.maps.networks import NeuralMap


class PlanarMap(nn.Module):
    """h(x) = x + N(x), with a network N whose output layer is zero at the start.

    Args:
        **config: of the network (see :class:`nsm.maps.NeuralMap`); ``out_dim`` is 2.
    """

    def __init__(self, **config: Any) -> None:
        super().__init__()
        self.network = NeuralMap(**{**config, "out_dim": 2})
        nn.init.zeros_(self.network.output.weight)
        nn.init.zeros_(self.network.output.bias)

    @property
    def config(self) -> dict[str, Any]:
        """What the map is built from."""
        return self.network.config

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return x + self.network(x)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        value, jacobian = self.network.value_and_jacobian(x)
        return x + value, torch.eye(2, dtype=x.dtype, device=x.device) + jacobian
