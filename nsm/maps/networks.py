"""Networks R² → Rⁿ that carry their Jacobian forward with the value."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import torch
from torch import Tensor, nn

from nsm.instantiation import check_trusted, made, made_with, target_of
from nsm.maps.activations import Activation, Softplus, as_activation
from nsm.maps.encodings import (
    Identity,
    as_encoding,
    pushed_forward,
    value_and_jacobian_stack,
)
from nsm.maps.mlp_with_tangents import MLPWithTangents
from nsm.maps.multilevel_spline import MultilevelSpline
from nsm.maps.spline_field import SplineField
from nsm.tensors import transformed


class PostActivationBlock(nn.Module):
    """act(x + L₂ act(L₁ x)): the residual block of the paper."""

    def __init__(self, width: int, activation: Activation) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        self.activation = activation

    def forward(self, x: Tensor) -> Tensor:
        return self.activation(x + self.second(self.activation(self.first(x))))


class PreActivationBlock(nn.Module):
    """x + L₂ act(L₁ act(x)), with L₂ zero at the start, so that the block begins as identity."""

    def __init__(self, width: int, activation: Activation) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        self.activation = activation

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.activation(self.first(self.activation(x))))


class DenseBlock(nn.Module):
    """act(L x): one layer of a multi-layer perceptron."""

    def __init__(self, width: int, activation: Activation) -> None:
        super().__init__()
        self.linear, self.activation = nn.Linear(width, width), activation

    def forward(self, x: Tensor) -> Tensor:
        return self.activation(self.linear(x))


# from width and activation to a module (N, width) to (N, width)
BLOCKS: dict[str, Callable[[int, Activation], nn.Module]] = {
    "plain": DenseBlock,
    "post": PostActivationBlock,
    "pre": PreActivationBlock,
}
# the ``skip`` of :class:`nsm.maps.mlp_with_tangents.MLPWithTangents`, for the blocks that it covers
SKIPS = {"plain": None, "post": "post", "pre": "pre"}
INITIALIZATIONS = ("xavier", "kaiming", "siren")
# what the features of a point add to the output past the network: nothing, or a linear function;
# fitted: one that starts as the surface's best (see :mod:`nsm.tasks.least_squares`)
LINEAR_SKIPS = ("none", "linear", "fitted")


class NeuralMap(nn.Module):
    """encoding → input layer → blocks → output layer, with value and Jacobian in one pass.

    Args:
        out_dim: 3 for a surface φ, 2 for a planar map h.
        width, depth: features of the hidden layers; number of blocks.
        block: ``plain`` (one layer each), ``post`` (the paper's residual), ``pre``, or a registered
            one.
        activation: a module or function (see :func:`nsm.maps.activations.as_activation`);
            softplus by default.
        encoding: a module with ``out_dim`` (see :mod:`nsm.maps.encodings`); none by default.
        initialization: ``xavier`` (normal, the paper's), ``kaiming`` (uniform) or ``siren``.
        linear_skip: ``none``; ``linear``: a linear function of the encoding's features, zero at the
            start, is added to the output; ``fitted``: the same, for a task that fits it.

    Attributes:
        config: settings with ``_target_`` from which :func:`build_stored` makes the network again.
        fused: whether one operation with a backward pass of its own evaluates all layers.

    Raises:
        ValueError: a parameter is out of range.
    """

    def __init__(
        self,
        out_dim: int = 3,
        width: int = 256,
        depth: int = 10,
        block: str = "pre",
        activation: Callable[[Tensor], Tensor] | None = None,
        encoding: nn.Module | None = None,
        initialization: str = "kaiming",
        linear_skip: str = "none",
    ) -> None:
        super().__init__()
        for name, value, known in (
            ("block", block, BLOCKS),
            ("initialization", initialization, INITIALIZATIONS),
            ("linear_skip", linear_skip, LINEAR_SKIPS),
        ):
            if value not in known:
                raise ValueError(f"map.{name} {value!r} is not one of {', '.join(known)}")
        if min(out_dim, width) < 1 or depth < 0:
            raise ValueError("map.width must be positive, and map.depth not negative")
        self.encoding = as_encoding(Identity() if encoding is None else encoding)
        self.activation = as_activation(Softplus() if activation is None else activation)
        self.config: dict[str, Any] = {
            "_target_": target_of(type(self)).replace("nsm.maps.networks.", "nsm.maps."),
            "out_dim": out_dim,
            "width": width,
            "depth": depth,
            "block": block,
            "initialization": initialization,
            "linear_skip": linear_skip,
            "activation": self.activation.config,
            "encoding": self.encoding.config,
        }
        # that operation gives the activation's own parameters no gradient
        self.fused = block in SKIPS and next(self.activation.parameters(), None) is None
        self.input = nn.Linear(self.encoding.out_dim, width)
        self.blocks = nn.ModuleList(BLOCKS[block](width, self.activation) for _ in range(depth))
        self.output = nn.Linear(width, out_dim)
        self.linear_skip: nn.Linear | None = None
        if linear_skip != "none":
            self.linear_skip = nn.Linear(self.encoding.out_dim, out_dim)
            nn.init.zeros_(self.linear_skip.weight)
            nn.init.zeros_(self.linear_skip.bias)
        modules = (self.input, *self.blocks.modules(), self.output)
        self.layers = [m for m in modules if isinstance(m, nn.Linear)]
        self._initialize(initialization)

    def _initialize(self, how: str) -> None:
        omega = float(getattr(self.activation, "omega", 1.0))
        for module in self.layers:
            if how == "xavier":
                nn.init.xavier_normal_(module.weight)
                nn.init.zeros_(module.bias)
            elif how == "siren":
                # Sitzmann et al., NeurIPS 2020: sin(ωz) keeps its distribution through the layers
                fan_in = module.in_features
                bound = 1 / fan_in if module is self.input else math.sqrt(6 / fan_in) / omega
                nn.init.uniform_(module.weight, -bound, bound)
        for block in self.blocks:
            if isinstance(block, PreActivationBlock):
                nn.init.zeros_(block.second.weight)
                nn.init.zeros_(block.second.bias)

    @property
    def _opens_with_activation(self) -> bool:
        # pre-activation blocks apply it themselves before their first layer, and need it at the end
        return not (len(self.blocks) and isinstance(self.blocks[0], PreActivationBlock))

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) points of Ω to (N, out_dim)."""
        features = self.encoding(x)
        if self._linear:
            return cast(nn.Linear, self.linear_skip)(features)
        y = self._after(features)
        return y if self.linear_skip is None else y + self.linear_skip(features)

    @property
    def _linear(self) -> bool:
        """Whether it is its linear skip alone, as a fit that is not trained: half the cost.

        On the CPU, as to look at the weights halts other devices.
        """
        weight, bias = self.output.weight, self.output.bias
        known = weight.device.type == "cpu" and not torch.compiler.is_compiling()
        if self.linear_skip is None or transformed() or not known:
            return False
        trained = torch.is_grad_enabled() and (weight.requires_grad or bias.requires_grad)
        return not trained and not weight.any() and not bias.any()

    def _after(self, features: Tensor) -> Tensor:
        """What comes after the encoding."""
        y = self.input(features)
        if self._opens_with_activation:
            y = self.activation(y)
        for block in self.blocks:
            y = block(y)
        if not self._opens_with_activation:
            y = self.activation(y)
        return self.output(y)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, out_dim) and Jacobians (N, out_dim, 2), in forward mode."""
        s = features = value_and_jacobian_stack(self.encoding, x)
        if self._linear:
            s = features.new_zeros(3, 1, 1)
        elif self.fused and not transformed():
            s = MLPWithTangents.apply(
                s,
                self.activation,
                SKIPS[self.config["block"]],
                torch.is_grad_enabled(),
                *(p for layer in self.layers for p in (layer.weight, layer.bias)),
            )
        else:
            s = pushed_forward(self._after, s)
        if self.linear_skip is not None:
            s = add_linear_skip(s, features, self.linear_skip.weight, self.linear_skip.bias)
        return s[0], s[1:].permute(1, 2, 0)


class PlanarNetwork(NeuralMap):
    """For maps h of Ω: on a domain with boundary a :class:`NeuralMap` of the same settings; on a
    closed domain a :class:`nsm.maps.MultilevelSpline`, which is as good there in half the time.

    The spline has as many cells as the finest of ``encoding.resolutions``; the settings here, and
    the activation, are of the network alone. ``map=mlp`` takes the network on all domains.

    Args:
        out_dim: 2 for a planar map h.
        width, depth: features of the hidden layers; number of blocks; with a boundary.
        block: as for :class:`NeuralMap`; with a boundary.
        activation, encoding: modules, as for :class:`NeuralMap`.
        initialization: ``xavier`` (normal, the paper's), ``kaiming`` (uniform) or ``siren``.
        linear_skip: ``none`` or ``linear``: a linear function of the encoding's features is added.
    """


def add_linear_skip(stack: Tensor, features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A linear function of features, with its tangents, added to a stack.

    Args:
        stack: (3, N, d), or (k, 3, N, d) of k networks.
        features: (3, N, d') or (k, 3, N, d').
        weight, bias: (d, d') and (d,), or (k, d, d') and (k, d).
    """
    out = stack + features @ weight.mT.unsqueeze(-3)
    out.select(-3, 0).add_(bias.unsqueeze(-2))
    return out


class ForeignMap(nn.Module):
    """A network without ``value_and_jacobian``, differentiated by PyTorch's forward mode.

    Args:
        network: (N, 2) to (N, n); each row depends on its own point alone.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, n)."""
        return self.network(x)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, n) and Jacobians (N, n, 2)."""
        stack = pushed_forward(self.network, Identity().value_and_jacobian_stack(x))
        return stack[0], stack[1:].permute(1, 2, 0)


def build_network(
    map: Mapping[str, Any] | None = None,
    activation: Mapping[str, Any] | None = None,
    encoding: Mapping[str, Any] | None = None,
    out_dim: int = 3,
) -> nn.Module:
    """The network that plain settings name; it and its parts record them as ``config``.

    Args:
        map: with ``_target_``, :class:`NeuralMap` by default; a class of the user's gets
            ``out_dim``, ``activation`` and ``encoding`` as far as its signature names them.
        activation, encoding: with ``_target_``; those of :class:`NeuralMap` by default.
        out_dim: 3 for a surface φ, 2 for a planar map h.

    Returns:
        A module with ``value_and_jacobian`` and ``config``.

    Raises:
        NsmError: a target cannot be imported or refuses its settings, or what it makes does not
            serve as that part.
    """
    settings = {"_target_": "nsm.maps.NeuralMap", **(map or {})}
    parts: dict[str, Any] = {}
    # in this order: the random numbers of a seed go to the encoding first
    if encoding is not None:
        parts["encoding"] = as_encoding(made(encoding), dict(encoding))
    if activation is not None:
        parts["activation"] = as_activation(made(activation), dict(activation))
    network: nn.Module = made_with(settings, out_dim=out_dim, **parts)
    if not hasattr(network, "value_and_jacobian"):
        network = ForeignMap(network)
    if not isinstance(
        network, (NeuralMap, MultilevelSpline, SplineField)
    ):  # these describe themselves
        configs = {key: part.config for key, part in parts.items()}
        network.config = {**settings, "out_dim": out_dim, **configs}  # type: ignore[assignment]
    return network


def build_stored(config: Mapping[str, Any], trust: Iterable[str] = ()) -> nn.Module:
    """The map that stored settings describe, perhaps a stranger's.

    Args:
        config: ``config`` of a map that :func:`build_network` made, or of a planar map around one.
        trust: modules other than nsm and torch from which to make objects.

    Raises:
        NotTrusted: a target in any other module.
        NsmError: a target cannot be imported or refuses its settings.
    """
    check_trusted(config, trust)
    if isinstance(config.get("network"), Mapping):
        inner = {
            key: build_stored(config[key], trust)
            for key in ("network", "start")
            if isinstance(config.get(key), Mapping)
        }
        around = {key: value for key, value in config.items() if key not in inner}
        whole: nn.Module = made_with(around, **inner)
        return whole
    parts = dict(config)
    named = {k: parts.pop(k, None) for k in ("activation", "encoding")}
    return build_network(parts, **named, out_dim=parts.pop("out_dim", 3))
