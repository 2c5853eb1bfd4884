"""Encodings of the plane: the features of a point (u, v) that a network takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from nsm.errors import NsmError
from nsm.instantiation import target_of
from nsm.maps import bsplines


class Encoding(Protocol):
    """A module from points x (N, 2) to features (N, out_dim).

    One without ``value_and_jacobian_stack`` is differentiated by :func:`pushed_forward`.
    """

    out_dim: int
    config: dict[str, Any]

    def __call__(self, x: Tensor) -> Tensor:
        """Points (N, 2) to (N, out_dim); each row depends on its own point alone."""
        ...


def pushed_forward(function: Callable[[Tensor], Tensor], stack: Tensor) -> Tensor:
    """A function of the rows of a tensor, with its tangents, by PyTorch's forward mode.

    Args:
        function: (N, d) to (N, d'); each row depends on its own row alone.
        stack: value and P − 1 tangents of its argument, (P, N, d).

    Returns:
        Value and tangents of the function, (P, N, d'), differentiable as the function is.
    """
    tangents, count = len(stack) - 1, stack.shape[1]
    # all tangents in one call, whose overhead is greater than its arithmetic
    points = stack[0].repeat(tangents, 1)
    value, pushed = torch.func.jvp(function, (points,), (stack[1:].flatten(0, 1),))[:2]
    return torch.cat([value[None, :count], pushed.unflatten(0, (tangents, count))])


def as_encoding(given: Any, config: dict[str, Any] | None = None) -> Encoding:
    """A module as an encoding with ``config``.

    Args:
        given: a module from points (N, 2) to features (N, ``out_dim``).
        config: settings with ``_target_`` that make it again; by default, its class.

    Raises:
        NsmError: it has no ``out_dim``.
    """
    if not isinstance(getattr(given, "out_dim", None), int):
        message = "encoding: it needs an attribute out_dim, its number of features"
        raise NsmError(message, kind="wrong_type", key="encoding")
    if not hasattr(given, "config"):
        given.config = dict(config or {"_target_": target_of(type(given))})
    encoding: Encoding = given
    return encoding


def value_and_jacobian_stack(encoding: Encoding, x: Tensor) -> Tensor:
    """Value and both tangents of an encoding at points (N, 2), stacked: (3, N, out_dim)."""
    if hasattr(encoding, "value_and_jacobian_stack"):
        stack: Tensor = encoding.value_and_jacobian_stack(x)
        return stack
    return pushed_forward(encoding, Identity(x.shape[1]).value_and_jacobian_stack(x))


def _config(encoding: nn.Module, in_dim: int, **parameters: Any) -> dict[str, Any]:
    of_input = {} if in_dim == 2 else {"in_dim": in_dim}
    return {"_target_": target_of(type(encoding)), **of_input, **parameters}


class Identity(nn.Module):
    """No encoding: the coordinates themselves.

    Args:
        in_dim: dimension of x.
    """

    def __init__(self, in_dim: int = 2) -> None:
        super().__init__()
        self.out_dim = in_dim
        self.config = _config(self, in_dim)

    def forward(self, x: Tensor) -> Tensor:
        return x

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, 2)."""
        tangents = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
        return torch.cat([x[None], tangents[:, None, :].expand(-1, x.shape[0], -1)])


class RandomFourierFeatures(nn.Module):
    """x, sin(2πBx), cos(2πBx) with a fixed Gaussian B (Tancik et al., NeurIPS 2020).

    Args:
        in_dim: dimension of x.
        features: rows of B; ``out_dim`` is ``in_dim + 2 * features``.
        sigma: standard deviation of B's entries, in cycles per unit of Ω.

    Raises:
        ValueError: there are no features, or sigma is not positive.
    """

    def __init__(self, in_dim: int = 2, features: int = 64, sigma: float = 2.0) -> None:
        super().__init__()
        if features < 1 or not 0 < sigma < math.inf:
            raise ValueError("encoding.features and encoding.sigma must be positive")
        self.config = _config(self, in_dim, features=features, sigma=sigma)
        self.register_buffer("frequencies", 2 * math.pi * sigma * torch.randn(features, in_dim))
        self.out_dim = in_dim + 2 * features

    frequencies: Tensor

    def forward(self, x: Tensor) -> Tensor:
        z = x @ self.frequencies.T
        return torch.cat([x, torch.sin(z), torch.cos(z)], dim=-1)

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        z = x @ self.frequencies.T
        sine, cosine = torch.sin(z), torch.cos(z)
        value = torch.cat([x, sine, cosine], dim=-1)
        rows = self.frequencies.T[:, None, :]  # (2, 1, features): dz/dx_i
        unit = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)[:, None, :]
        tangents = torch.cat([unit.expand(-1, x.shape[0], -1), rows * cosine, -rows * sine], dim=-1)
        return torch.cat([value[None], tangents])


class SplineGrid(nn.Module):
    """Multi-resolution grids of trainable features, blended by uniform B-splines.

    Dense grids over [-extent, extent]², one per resolution, in the manner of multi-resolution
    hash encodings (Müller et al., SIGGRAPH 2022). The plane is small enough to need no hashing.
    B-splines in place of linear interpolation make the map C¹ (degree 2) or C² (degree 3), which
    the distortion energies of composed maps differentiate.

    Args:
        in_dim: 2, the only dimension that there is.
        resolutions: cells a side, one number per level.
        features: features per level; ``out_dim`` is ``2 + len(resolutions) * features``.
        degree: 2 or 3.
        extent: half the side of the square that the grid covers; x outside is clamped to it.

    Raises:
        ValueError: a parameter is out of range.
    """

    def __init__(
        self,
        in_dim: int = 2,
        resolutions: Sequence[int] = (8, 16, 32, 64, 128),
        features: int = 4,
        degree: int = 2,
        extent: float = 1.05,
    ) -> None:
        super().__init__()
        if in_dim != 2 or degree not in (2, 3):
            raise ValueError("encoding.degree must be 2 or 3, and encoding.in_dim 2")
        if not resolutions or min(resolutions) < 1:
            raise ValueError("encoding.resolutions needs one level or more, of 1 cell or more each")
        if features < 1 or extent <= 0:
            raise ValueError("encoding.features and encoding.extent must be positive")
        self.resolutions = [int(r) for r in resolutions]
        self.config = _config(
            self,
            in_dim,
            resolutions=self.resolutions,
            features=features,
            degree=degree,
            extent=float(extent),
        )
        self.degree, self.extent, self.features = degree, float(extent), features
        self.sides = [r + degree for r in self.resolutions]  # of the tables
        self.tables = nn.ParameterList(
            nn.Parameter(1e-2 * torch.randn(side**2, features)) for side in self.sides
        )
        self.out_dim = in_dim + features * len(self.resolutions)

    @property
    def grids(self) -> list[bsplines.Grid]:
        """Of each level."""
        kind = bsplines.CLAMPED
        return [bsplines.Grid((r, r), self.extent, self.degree, kind) for r in self.resolutions]

    def seen(self, x: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """What points see of a level's table, which its features are linear in.

        Args:
            x: (N, 2).
            level: number of the resolution.

        Returns:
            rows (N, k²) of the table; their weights (3, N, k²) in value and both tangents.
        """
        return bsplines.seen(x, self.grids[level])

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        unit = Identity(2).value_and_jacobian_stack(x)
        return torch.cat([unit, self.blended(x, list(self.tables), tangents=True)], dim=-1)

    def blended(self, x: Tensor, tables: Sequence[Tensor], tangents: bool) -> Tensor:
        """Features of all levels at points (N, 2), read off tables like those of the grid:
        (P, N, L · F), P = 1, or 3 with both tangents. Values alone are differentiable twice."""
        twice = x.requires_grad and not tangents
        return (bsplines.read_plainly if twice else bsplines.read)(x, self.grids, tables, tangents)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.blended(x, list(self.tables), tangents=False)[0]], dim=-1)
