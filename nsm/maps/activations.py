"""Activations as pairs: the value and, beside it, the derivative that carries tangents."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

ValueAndSlope = tuple[Tensor, Tensor]


def _softplus(z: Tensor, beta: float) -> ValueAndSlope:
    return F.softplus(z, beta=beta), torch.sigmoid(beta * z)


def _relu(z: Tensor) -> ValueAndSlope:
    return F.relu(z), (z > 0).to(z.dtype)


def _leaky_relu(z: Tensor, negative_slope: float) -> ValueAndSlope:
    slope = torch.where(z > 0, torch.ones_like(z), torch.full_like(z, negative_slope))
    return F.leaky_relu(z, negative_slope), slope


def _silu(z: Tensor) -> ValueAndSlope:
    s = torch.sigmoid(z)
    value = z * s
    return value, s + value * (1 - s)


def _gelu(z: Tensor) -> ValueAndSlope:
    cdf = 0.5 * (1 + torch.erf(z / math.sqrt(2)))
    return z * cdf, cdf + z * torch.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


def _tanh(z: Tensor) -> ValueAndSlope:
    t = torch.tanh(z)
    return t, 1 - t * t


def _elu(z: Tensor, alpha: float) -> ValueAndSlope:
    value = F.elu(z, alpha)
    return value, torch.where(z > 0, torch.ones_like(z), alpha * torch.exp(z.clamp(max=0)))


def _sine(z: Tensor, omega: float) -> ValueAndSlope:
    return torch.sin(omega * z), omega * torch.cos(omega * z)


# name -> (function, default parameters)
ACTIVATIONS: dict[str, tuple[Callable[..., ValueAndSlope], dict[str, float]]] = {
    "softplus": (_softplus, {"beta": 1.0}),
    "relu": (_relu, {}),
    "leaky_relu": (_leaky_relu, {"negative_slope": 0.01}),
    "silu": (_silu, {}),
    "gelu": (_gelu, {}),
    "tanh": (_tanh, {}),
    "elu": (_elu, {"alpha": 1.0}),
    "sine": (_sine, {"omega": 30.0}),
}


class Activation(nn.Module):
    """An activation that answers its value and its derivative together.

    Args:
        name: a key of ``ACTIVATIONS``.
        **parameters: its parameters (``beta`` of softplus, ``omega`` of sine, ...).

    Raises:
        ValueError: the name or a parameter is not known.
    """

    def __init__(self, name: str, **parameters: Any) -> None:
        super().__init__()
        if name not in ACTIVATIONS:
            raise ValueError(f"activation {name!r} is not one of {', '.join(ACTIVATIONS)}")
        self.name = name
        self.function, defaults = ACTIVATIONS[name]
        unknown = set(parameters) - set(defaults)
        if unknown:
            raise ValueError(f"activation {name!r} has no parameter {', '.join(sorted(unknown))}")
        self.parameters_ = {**defaults, **parameters}

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        """``(f(z), f'(z))``, both of the shape of ``z``."""
        return self.function(z, **self.parameters_)

    def forward(self, z: Tensor) -> Tensor:
        return self.function(z, **self.parameters_)[0]

    def push(self, s: Tensor) -> Tensor:
        """Value and tangents, stacked (3, N, d): f on the first, f' times the others."""
        value, slope = self.value_and_slope(s[0])
        return torch.cat([value[None], slope[None] * s[1:]])
