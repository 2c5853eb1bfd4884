"""Activations that carry tangents along, forward and backward.

The backward pass of :class:`nsm.maps.mlp_with_tangents.MLPWithTangents` needs f′ and f″ of an
activation f. Our own activations give both in closed form; any other module or function is
differentiated by PyTorch (:class:`Elementwise`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nsm.errors import NsmError
from nsm.instantiation import target_of

ValueAndSlope = tuple[Tensor, Tensor]


class Activation(nn.Module):
    """Base of the activations: f entry by entry, with its derivatives.

    Subclasses answer ``value_and_slope`` and one of ``slope_from_value`` and ``curvature``: where
    f(z) alone tells both derivatives, the forward pass keeps nothing else.

    """

    from_value: ClassVar[bool] = False  # whether ``slope_from_value`` is there
    settings: ClassVar[tuple[str, ...]] = ()  # names of the constructor's arguments, all kept

    @property
    def config(self) -> dict[str, Any]:
        """Settings with ``_target_`` that make the activation again."""
        return {"_target_": target_of(type(self)), **{k: getattr(self, k) for k in self.settings}}

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        """f(z) and f′(z), each of the shape of z."""
        raise NotImplementedError

    def slope_from_value(self, a: Tensor) -> tuple[Tensor, Tensor | None]:
        """f′(z) and f″(z)/f′(z) from a = f(z); None where f″ is zero."""
        raise NotImplementedError

    def curvature(self, z: Tensor) -> Tensor:
        """f″(z), of the shape of z."""
        raise NotImplementedError

    def forward(self, z: Tensor) -> Tensor:
        return self.value_and_slope(z)[0]

    def jvp_(self, z: Tensor, keep: bool) -> tuple[Tensor, ...]:
        """Turn a stack z (P, n, d) of value and tangents into that of f, in place.

        Returns:
            What ``vjp_`` needs beside the result, if ``keep``: nothing, or f′ and f″ times the
            tangents.
        """
        kept: tuple[Tensor, ...] = ()
        value, slope = self.value_and_slope(z[0])
        if keep and not self.from_value:
            kept = (slope, self.curvature(z[0]) * z[1:])
        z[0] = value
        z[1:].mul_(slope)
        return kept

    def vjp_(self, gradient: Tensor, result: Tensor, kept: tuple[Tensor, ...]) -> None:
        """Turn the gradient (P, n, d) by f's stack into that by z's, in place.

        Args:
            gradient: of the loss by ``result``.
            result: the stack that ``jvp_`` left.
            kept: what ``jvp_`` returned.
        """
        if kept:
            slope, bends = kept
            bend: Tensor | None = (gradient[1:] * bends).sum(dim=0)
        else:
            slope, share = self.slope_from_value(result[0])
            bend = None
            if share is not None:
                bend = gradient[1] * result[1]
                for g, a in zip(gradient[2:], result[2:], strict=True):
                    bend.addcmul_(g, a)
                bend.mul_(share)
        gradient.mul_(slope)
        if bend is not None:
            gradient[0].add_(bend)


def _positive(name: str, value: float) -> float:
    if not (isinstance(value, (int, float)) and 0 < value < math.inf):
        raise ValueError(f"activation.{name} must be a positive number, not {value}")
    return value


class Softplus(Activation):
    """log(1 + exp(βz))/β, smooth.

    Args:
        beta: sharpness β of the bend; the larger, the closer to ReLU.

    Raises:
        ValueError: β is not positive.
    """

    from_value, settings = True, ("beta",)

    def __init__(self, beta: float = 1.0) -> None:
        super().__init__()
        self.beta = _positive("beta", beta)

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        return F.softplus(z, beta=self.beta), torch.sigmoid(self.beta * z)

    def slope_from_value(self, a: Tensor) -> tuple[Tensor, Tensor]:
        slope = torch.expm1(-self.beta * a).neg_()  # σ(βz) = 1 − exp(−βa)
        return slope, (1 - slope).mul_(self.beta)  # f″ = β(1 − f′)·f′


class LeakyReLU(Activation):
    """Piecewise linear: z above zero, a small slope below.

    Args:
        negative_slope: slope below zero, not negative.

    Raises:
        ValueError: the slope is negative.
    """

    from_value, settings = True, ("negative_slope",)

    def __init__(self, negative_slope: float = 0.01) -> None:
        if not negative_slope >= 0:
            raise ValueError(f"activation.negative_slope={negative_slope} is negative")
        super().__init__()
        self.negative_slope = negative_slope

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        slope = torch.where(z > 0, torch.ones_like(z), torch.full_like(z, self.negative_slope))
        return F.leaky_relu(z, self.negative_slope), slope

    def slope_from_value(self, a: Tensor) -> tuple[Tensor, None]:
        low = self.negative_slope
        return (a > 0).to(a.dtype).mul_(1 - low).add_(low), None


class ReLU(Activation):
    """Piecewise linear: z above zero, zero below."""

    from_value = True

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        return F.relu(z), (z > 0).to(z.dtype)

    def slope_from_value(self, a: Tensor) -> tuple[Tensor, None]:
        return (a > 0).to(a.dtype), None


class SiLU(Activation):
    """z·sigmoid(z), smooth."""

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        s = torch.sigmoid(z)
        value = z * s
        return value, s + value * (1 - s)

    def curvature(self, z: Tensor) -> Tensor:
        s = torch.sigmoid(z)
        return s * (1 - s) * (2 + z * (1 - 2 * s))


class GELU(Activation):
    """z·Φ(z), with Φ the normal distribution; smooth."""

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        cdf = 0.5 * (1 + torch.erf(z / math.sqrt(2)))
        return z * cdf, cdf + z * torch.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)

    def curvature(self, z: Tensor) -> Tensor:
        square = z * z
        return torch.exp(-0.5 * square) * (2 - square) / math.sqrt(2 * math.pi)


class Tanh(Activation):
    """The hyperbolic tangent, smooth and bounded."""

    from_value = True

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        t = torch.tanh(z)
        return t, 1 - t * t

    def slope_from_value(self, a: Tensor) -> tuple[Tensor, Tensor]:
        return 1 - a * a, -2 * a


class ELU(Activation):
    """Linear above zero, an exponential below; C¹ for α = 1.

    Args:
        alpha: depth α of the exponential below zero.

    Raises:
        ValueError: α is not positive.
    """

    from_value, settings = True, ("alpha",)

    def __init__(self, alpha: float = 1.0) -> None:
        super().__init__()
        self.alpha = _positive("alpha", alpha)

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        below = self.alpha * torch.exp(z.clamp(max=0))
        return F.elu(z, self.alpha), torch.where(z > 0, torch.ones_like(z), below)

    def slope_from_value(self, a: Tensor) -> tuple[Tensor, Tensor]:
        return torch.where(a > 0, 1.0, a + self.alpha), (a <= 0).to(a.dtype)


class Sine(Activation):
    """sin(ωz) (SIREN, Sitzmann et al., NeurIPS 2020); goes with map.initialization=siren.

    Args:
        omega: frequency ω.

    Raises:
        ValueError: ω is not positive.
    """

    settings = ("omega",)

    def __init__(self, omega: float = 30.0) -> None:
        super().__init__()
        self.omega = _positive("omega", omega)

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        return torch.sin(self.omega * z), self.omega * torch.cos(self.omega * z)

    def curvature(self, z: Tensor) -> Tensor:
        return -(self.omega**2) * torch.sin(self.omega * z)


class Elementwise(Activation):
    """Any differentiable function of one number, or module of such, with derivatives by PyTorch.

    Args:
        function: z (...) to f(z) (...), entry by entry.
        config: settings with ``_target_`` that make the function again; by default, its own
            ``config``, or its class or name.
    """

    def __init__(
        self, function: Callable[[Tensor], Tensor], config: dict[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.function = function
        self._config = config or getattr(function, "config", None) or _settings_of(function)

    @property
    def config(self) -> dict[str, Any]:
        return dict(self._config)

    def forward(self, z: Tensor) -> Tensor:
        return self.function(z)

    def value_and_slope(self, z: Tensor) -> ValueAndSlope:
        both = torch.func.jvp(self.function, (z,), (torch.ones_like(z),))
        return both[0], both[1]

    def curvature(self, z: Tensor) -> Tensor:
        def slope(y: Tensor) -> Tensor:
            return self.value_and_slope(y)[1].sum()

        # in reverse mode: PyTorch has no second forward derivative of some, Mish among them
        bend: Tensor = torch.func.grad(slope)(z)
        return bend


def _settings_of(function: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Settings that make a module with default parameters, or a function, again; else none."""
    if isinstance(function, nn.Module):
        return {"_target_": target_of(type(function))}
    if not hasattr(function, "__qualname__"):  # a callable object, such as a partial function
        return {}
    name = function.__name__
    # functions of torch that are written in C do not know their module
    target = f"torch.{name}" if getattr(torch, name, None) is function else target_of(function)
    return {"_target_": target, "_partial_": True}


def as_activation(
    given: Activation | Callable[[Tensor], Tensor], config: dict[str, Any] | None = None
) -> Activation:
    """An activation of ours as it is; any other module or function as :class:`Elementwise`.

    Raises:
        NsmError: what is given cannot be called, or does not keep the shape of its argument.
    """
    if isinstance(given, Activation):
        return given
    if not callable(given):
        message = f"activation: a {type(given).__name__} is no function of a tensor"
        raise NsmError(message, kind="wrong_type", key="activation")
    activation = Elementwise(given, config)
    with torch.no_grad():
        value = activation(torch.linspace(-1.0, 1.0, 6).view(2, 3))
    if not isinstance(value, Tensor) or value.shape != (2, 3):
        message = "activation: it must give one value for each entry of its argument"
        raise NsmError(message, kind="wrong_shape", key="activation")
    return activation
