"""Networks R² → Rⁿ that carry their Jacobian forward with the value."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from nsm.maps.activations import Activation
from nsm.maps.encodings import (
    ENCODINGS,
    Encoding,
    pushed_forward,
    value_and_jacobian_stack,
)
from nsm.maps.mlp_with_tangents import MLPWithTangents


class PostActivationBlock(nn.Module):
    """act(x + L₂ act(L₁ x)): the published residual block."""

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
    """act(L x): one layer of a plain multi-layer perceptron."""

    def __init__(self, width: int, activation: Activation) -> None:
        super().__init__()
        self.linear, self.activation = nn.Linear(width, width), activation

    def forward(self, x: Tensor) -> Tensor:
        return self.activation(self.linear(x))


# from the features and the activation to a module (N, width) to (N, width)
BLOCKS: dict[str, Callable[[int, Activation], nn.Module]] = {
    "plain": DenseBlock,
    "post": PostActivationBlock,
    "pre": PreActivationBlock,
}
# what every second layer adds (see :class:`nsm.maps.mlp_with_tangents.MLPWithTangents`); other
# blocks have no written-out backward pass
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
        block: ``plain`` (one layer each), ``post`` (published residual), ``pre``, or one that was
            registered.
        activation: ``{"name": ..., parameters}``; see :mod:`nsm.maps.activations`.
        encoding: ``{"name": ..., parameters}``; see :mod:`nsm.maps.encodings`.
        initialization: ``xavier`` (normal, the paper's), ``kaiming`` (uniform) or ``siren``.
        linear_skip: ``none``; ``linear``: a linear function of the encoding's features, zero at the
            start, is added to the output; ``fitted``: the same, for a task that fits it.
    """

    def __init__(
        self,
        out_dim: int = 3,
        width: int = 256,
        depth: int = 10,
        block: str = "pre",
        activation: dict[str, Any] | None = None,
        encoding: dict[str, Any] | None = None,
        initialization: str = "kaiming",
        linear_skip: str = "none",
    ) -> None:
        super().__init__()
        activation = dict(activation or {"name": "softplus"})
        encoding = dict(encoding or {"name": "identity"})
        self.config: dict[str, Any] = {
            "out_dim": out_dim,
            "width": width,
            "depth": depth,
            "block": block,
            "activation": dict(activation),
            "encoding": dict(encoding),
            "initialization": initialization,
            "linear_skip": linear_skip,
        }
        if block not in BLOCKS:
            raise ValueError(f"block {block!r} is not one of {', '.join(BLOCKS)}")
        if initialization not in INITIALIZATIONS:
            raise ValueError(
                f"initialization {initialization!r} is not one of {', '.join(INITIALIZATIONS)}"
            )
        if linear_skip not in LINEAR_SKIPS:
            raise ValueError(f"linear_skip {linear_skip!r} is not one of {', '.join(LINEAR_SKIPS)}")
        name = encoding.pop("name")
        if name not in ENCODINGS:
            raise ValueError(f"encoding {name!r} is not one of {', '.join(ENCODINGS)}")
        self.encoding: Encoding = ENCODINGS[name](2, **encoding)
        self.activation = Activation(**activation)
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
        omega = float(self.activation.parameters_.get("omega", 1.0))
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
        y = self._after(features)
        return y if self.linear_skip is None else y + self.linear_skip(features)

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
        if self.config["block"] in SKIPS:
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


def build_map(config: dict[str, Any]) -> NeuralMap:
    """The network that a configuration (``NeuralMap.config``, or one from ``conf/map``) names."""
    return NeuralMap(**config)
