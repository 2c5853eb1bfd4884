"""Networks that the tests of the maps share, from short settings."""

from __future__ import annotations

from typing import Any

import torch

from nsm.maps import DiscMap, PlanarMap, SquareMap, build_network

ACTIVATIONS = ("Softplus", "ReLU", "LeakyReLU", "SiLU", "GELU", "Tanh", "ELU", "Sine")
PLANAR = {None: PlanarMap, "disc": DiscMap, "square": SquareMap}


def activation(name: str, **parameters: Any) -> dict[str, Any]:
    """Settings of one of our activations."""
    return {"_target_": f"nsm.maps.activations.{name}", **parameters}


def encoding(name: str, **parameters: Any) -> dict[str, Any]:
    """Settings of one of our encodings."""
    return {"_target_": f"nsm.maps.encodings.{name}", **parameters}


def network(
    act: dict[str, Any] | None = None,
    enc: dict[str, Any] | None = None,
    out_dim: int = 3,
    **settings: Any,
) -> torch.nn.Module:
    """A network in float64."""
    return build_network(settings, act, enc, out_dim=out_dim).double()


def planar(
    onto: str | None = None,
    act: dict[str, Any] | None = None,
    enc: dict[str, Any] | None = None,
    **settings: Any,
) -> torch.nn.Module:
    """A planar map in float64, unconstrained or one that keeps a domain by construction."""
    kind = PLANAR[onto]
    return kind(network(act, enc, kind.network_out_dim, **settings))


def randomised(map_: torch.nn.Module, scale: float = 0.3) -> torch.nn.Module:
    """The map with every parameter random, so that none is still zero."""
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in map_.parameters():
            parameter.copy_(scale * torch.randn_like(parameter))
    return map_


class Net(torch.nn.Module):
    """A network of a user's, that knows nothing of nsm."""

    def __init__(self, out_dim, width=4, activation=None):
        super().__init__()
        self.first, self.last = torch.nn.Linear(2, width), torch.nn.Linear(width, out_dim)
        self.activation = activation

    def forward(self, x):
        return self.last(self.activation(self.first(x)))


class Polar(torch.nn.Module):
    """An encoding of a user's."""

    out_dim = 3

    def forward(self, x):
        return torch.cat([x, (x * x).sum(dim=-1, keepdim=True)], dim=-1)
