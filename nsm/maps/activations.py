"""Activations with what their tangents need: the slope, and how the slope itself changes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

ValueAndSlope = tuple[Tensor, Tensor]


def _softplus(z: Tensor, beta: float) -> ValueAndSlope:
    return F.softplus(z, beta=beta), torch.sigmoid(beta * z)


def _softplus_from_value(a: Tensor, beta: float) -> tuple[Tensor, Tensor]:
    slope = torch.expm1(-beta * a).neg_()  # σ(βz) = 1 − exp(−βa)
    return slope, (1 - slope).mul_(beta)  # f″ = β(1 − f′)·f′


def _relu(z: Tensor) -> ValueAndSlope:
    return F.relu(z), (z > 0).to(z.dtype)


def _relu_from_value(a: Tensor) -> tuple[Tensor, None]:
    return (a > 0).to(a.dtype), None


def _leaky_relu(z: Tensor, negative_slope: float) -> ValueAndSlope:
    slope = torch.where(z > 0, torch.ones_like(z), torch.full_like(z, negative_slope))
    return F.leaky_relu(z, negative_slope), slope


def _leaky_relu_from_value(a: Tensor, negative_slope: float) -> tuple[Tensor, None]:
    return (a > 0).to(a.dtype).mul_(1 - negative_slope).add_(negative_slope), None


def _silu(z: Tensor) -> ValueAndSlope:
    s = torch.sigmoid(z)
    value = z * s
    return value, s + value * (1 - s)


def _silu_curvature(z: Tensor) -> Tensor:
    s = torch.sigmoid(z)
    return s * (1 - s) * (2 + z * (1 - 2 * s))


def _gelu(z: Tensor) -> ValueAndSlope:
    cdf = 0.5 * (1 + torch.erf(z / math.sqrt(2)))
    return z * cdf, cdf + z * torch.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


def _gelu_curvature(z: Tensor) -> Tensor:
    square = z * z
    return torch.exp(-0.5 * square) * (2 - square) / math.sqrt(2 * math.pi)


def _tanh(z: Tensor) -> ValueAndSlope:
    t = torch.tanh(z)
    return t, 1 - t * t


def _tanh_from_value(a: Tensor) -> tuple[Tensor, Tensor]:
    return 1 - a * a, -2 * a


def _elu(z: Tensor, alpha: float) -> ValueAndSlope:
    value = F.elu(z, alpha)
    return value, torch.where(z > 0, torch.ones_like(z), alpha * torch.exp(z.clamp(max=0)))


def _elu_from_value(a: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    return torch.where(a > 0, 1.0, a + alpha), (a <= 0).to(a.dtype)


def _sine(z: Tensor, omega: float) -> ValueAndSlope:
    return torch.sin(omega * z), omega * torch.cos(omega * z)


def _sine_curvature(z: Tensor, omega: float) -> Tensor:
    return -(omega**2) * torch.sin(omega * z)


@dataclass(frozen=True)
class Formulas:
    """An activation f, and where the backward pass takes f′ and f″ from.

    Attributes:
        value_and_slope: z ↦ (f(z), f′(z)).
        from_value: a = f(z) ↦ (f′(z), f″(z)/f′(z), or None where f″ is zero), for those whose
            value tells both: nothing but the value has to be kept.
        curvature: z ↦ f″(z), for the others.
        defaults: its parameters; none may be negative.
    """

    value_and_slope: Callable[..., ValueAndSlope]
    from_value: Callable[..., tuple[Tensor, Tensor | None]] | None = None
    curvature: Callable[..., Tensor] | None = None
    defaults: dict[str, float] = field(default_factory=dict)


def elementwise(function: Callable[..., Tensor], defaults: dict[str, float]) -> Formulas:
    """The formulas of a function z ↦ f(z), differentiated by PyTorch's forward mode."""

    def value_and_slope(z: Tensor, **parameters: float) -> ValueAndSlope:
        both = torch.func.jvp(partial(function, **parameters), (z,), (torch.ones_like(z),))
        return both[0], both[1]

    def curvature(z: Tensor, **parameters: float) -> Tensor:
        def slope(y: Tensor) -> Tensor:
            return value_and_slope(y, **parameters)[1]

        bend: Tensor = torch.func.jvp(slope, (z,), (torch.ones_like(z),))[1]
        return bend

    return Formulas(value_and_slope, curvature=curvature, defaults=defaults)


ACTIVATIONS: dict[str, Formulas] = {
    "softplus": Formulas(_softplus, from_value=_softplus_from_value, defaults={"beta": 1.0}),
    "relu": Formulas(_relu, from_value=_relu_from_value),
    "leaky_relu": Formulas(
        _leaky_relu, from_value=_leaky_relu_from_value, defaults={"negative_slope": 0.01}
    ),
    "silu": Formulas(_silu, curvature=_silu_curvature),
    "gelu": Formulas(_gelu, curvature=_gelu_curvature),
    "tanh": Formulas(_tanh, from_value=_tanh_from_value),
    "elu": Formulas(_elu, from_value=_elu_from_value, defaults={"alpha": 1.0}),
    "sine": Formulas(_sine, curvature=_sine_curvature, defaults={"omega": 30.0}),
}


class Activation(nn.Module):
    """An activation that carries tangents along, forwards and backwards.

    Args:
        name: a key of ``ACTIVATIONS``.
        **parameters: its parameters (``beta`` of softplus, ``omega`` of sine, ...).

    Raises:
        ValueError: the name or a parameter is not known, or a parameter is negative.
    """

    def __init__(self, name: str, **parameters: Any) -> None:
        super().__init__()
        if name not in ACTIVATIONS:
            raise ValueError(f"activation {name!r} is not one of {', '.join(ACTIVATIONS)}")
        self.name, self.formulas = name, ACTIVATIONS[name]
        unknown = set(parameters) - set(self.formulas.defaults)
        if unknown:
            raise ValueError(f"activation {name!r} has no parameter {', '.join(sorted(unknown))}")
        self.parameters_ = {**self.formulas.defaults, **parameters}
        for key, value in self.parameters_.items():
            if not value >= 0:
                raise ValueError(f"activation.{key}={value} is negative")

    def forward(self, z: Tensor) -> Tensor:
        return self.formulas.value_and_slope(z, **self.parameters_)[0]

    def jvp_(self, z: Tensor, keep: bool) -> tuple[Tensor, ...]:
        """Turn a stack z (P, n, d) of value and tangents into that of f, in place.

        Returns:
            What ``vjp_`` needs beside the result, if ``keep``: nothing, or f′ and f″ times the
            tangents.
        """
        kept: tuple[Tensor, ...] = ()
        value, slope = self.formulas.value_and_slope(z[0], **self.parameters_)
        if keep and self.formulas.curvature is not None:
            bends = self.formulas.curvature(z[0], **self.parameters_) * z[1:]
            kept = (slope, bends)
        z[0] = value
        z[1:].mul_(slope)
        return kept

    def vjp_(self, gradient: Tensor, result: Tensor, kept: tuple[Tensor, ...]) -> None:
        """Turn the gradient (P, n, d) by f's stack into that by z's, in place.

        Args:
            gradient: of the loss by ``result``.
            result: what ``jvp_`` made.
            kept: what it returned.
        """
        if kept:
            slope, bends = kept
            bend = (gradient[1:] * bends).sum(dim=0)
        else:
            assert self.formulas.from_value is not None
            slope, share = self.formulas.from_value(result[0], **self.parameters_)
            bend = None
            if share is not None:
                bend = gradient[1] * result[1]
                for g, a in zip(gradient[2:], result[2:], strict=True):
                    bend.addcmul_(g, a)
                bend.mul_(share)
        gradient.mul_(slope)
        if bend is not None:
            gradient[0].add_(bend)
