"""Planar maps h: Ω → R² that start as a given map."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from nsm.maps.encodings import Encoding, value_and_jacobian_stack
from nsm.maps.planar import PlanarMap


class LinearInFeatures(nn.Module):
    """A linear function of an encoding's features, and their derivatives.

    Args:
        out_dim: of the values.
        encoding: from points (N, 2) to the features.

    Attributes:
        config: settings, which :func:`nsm.maps.build_network` records.
    """

    config: dict[str, Any]

    def __init__(self, out_dim: int, encoding: Encoding) -> None:
        super().__init__()
        self.encoding: Any = encoding
        self.linear = nn.Linear(encoding.out_dim, out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, out_dim)."""
        value: Tensor = self.linear(self.encoding(x))
        return value

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, out_dim) and Jacobians (N, out_dim, 2)."""
        stack = value_and_jacobian_stack(self.encoding, x) @ self.linear.weight.t()
        value = stack[0] if self.linear.bias is None else stack[0] + self.linear.bias
        return value, stack[1:].permute(1, 2, 0)


class StartedMap(PlanarMap):
    """h(x) = s(x) + N(x), unconstrained, with a map s that is not trained.

    Args:
        network: N, as of every planar map.
        start: s, (N, 2) to (N, 2), with ``value_and_jacobian`` and ``config``.
    """

    def __init__(self, network: nn.Module, start: nn.Module) -> None:
        super().__init__(network)
        self.start: Any = start.requires_grad_(False)

    @property
    def config(self) -> dict[str, Any]:
        return {**super().config, "start": self.start.config}

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        value: Tensor = self.start(x) + self.network(x)
        return value

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        at, slope = self.start.value_and_jacobian(x)
        value, jacobian = self.network.value_and_jacobian(x)
        return at + value, slope + jacobian
