"""Planar maps h: Ω → R² that start as the identity."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.maps.networks import NeuralMap


class IdentityInitializedMap(nn.Module):
    """A map made of a network whose output layer is zero at the start."""

    out_dim: int
    onto: str | None = None  # the domain that the map keeps to by construction

    def __init__(self, **config: Any) -> None:
        super().__init__()
        self.network = NeuralMap(**{**config, "out_dim": self.out_dim})
        nn.init.zeros_(self.network.output.weight)
        nn.init.zeros_(self.network.output.bias)

    @classmethod
    def around(cls, network: nn.Module) -> IdentityInitializedMap:
        """The map of a network that is there, which also may be several in one batch."""
        made = cls.__new__(cls)
        nn.Module.__init__(made)
        made.network = network  # type: ignore[assignment]
        return made

    @property
    def config(self) -> dict[str, Any]:
        """What the map is built from (see :func:`build_planar`)."""
        return {**self.network.config, "onto": self.onto}


class PlanarMap(IdentityInitializedMap):
    """h(x) = x + N(x), with a network N whose output layer is zero at the start.

    Args:
        **config: of the network (see :class:`nsm.maps.NeuralMap`); ``out_dim`` is 2.
    """

    out_dim = 2

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return x + self.network(x)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        value, jacobian = self.network.value_and_jacobian(x)
        return x + value, torch.eye(2, dtype=x.dtype, device=x.device) + jacobian


class DiscMap(IdentityInitializedMap):
    """h(x) = R(θ(x))·(x + (1 − ‖x‖²)·N(x)): the circle goes to itself, whatever N and θ are.

    The boundary constraint (METHOD, B) holds by construction, and the image of ∂Ω slides by θ.

    Args:
        **config: of the network (N, θ); ``out_dim`` is 3.
    """

    out_dim = 3
    onto = "disc"

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        out = self.network(x)
        y = x + (1 - (x * x).sum(dim=-1, keepdim=True)) * out[..., :2]
        return _turned(y, out[..., 2].cos(), out[..., 2].sin())

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        out, jacobian = self.network.value_and_jacobian(x)
        room = 1 - (x * x).sum(dim=-1, keepdim=True)
        y = x + room * out[..., :2]
        eye = torch.eye(2, dtype=x.dtype, device=x.device)
        inner = eye + room[..., None] * jacobian[..., :2, :]
        inner = inner - 2 * out[..., :2, None] * x[..., None, :]
        # d(R y) = R (dy + y⊥ dθ)
        across = torch.stack([-y[..., 1], y[..., 0]], dim=-1)
        inner = inner + across[..., None] * jacobian[..., 2:3, :]
        c, s = out[..., 2].cos(), out[..., 2].sin()
        columns = [_turned(inner[..., k], c, s) for k in (0, 1)]
        return _turned(y, c, s), torch.stack(columns, dim=-1)


class SquareMap(IdentityInitializedMap):
    """h_i(x) = x_i + (1 − x_i²)·N_i(x): each side of the square goes to itself, corners stay.

    Args:
        **config: of the network N; ``out_dim`` is 2.
    """

    out_dim = 2
    onto = "square"

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return x + (1 - x * x) * self.network(x)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        out, jacobian = self.network.value_and_jacobian(x)
        room = 1 - x * x
        return x + room * out, torch.diag_embed(1 - 2 * x * out) + room[..., None] * jacobian


Planar = PlanarMap | DiscMap | SquareMap
_ONTO: dict[str | None, type[Planar]] = {None: PlanarMap, "disc": DiscMap, "square": SquareMap}


def build_planar(config: dict[str, Any]) -> Planar:
    """The planar map of a configuration (``config`` of any of these classes).

    Args:
        config: of the network, with ``onto``: the domain that the map keeps to by construction,
            ``disc`` or ``square``; without it nothing holds the map.

    Raises:
        ValueError: ``onto`` is not a domain.
    """
    network = dict(config)
    onto = network.pop("onto", None)
    if onto not in _ONTO:
        raise ValueError(f"onto {onto!r} is not a domain")
    return _ONTO[onto](**network)


def _turned(y: Tensor, c: Tensor, s: Tensor) -> Tensor:
    """y (..., 2) turned by the angles whose cosine and sine (...) are given."""
    return torch.stack([c * y[..., 0] - s * y[..., 1], s * y[..., 0] + c * y[..., 1]], dim=-1)
