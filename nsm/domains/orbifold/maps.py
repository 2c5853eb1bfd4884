"""Functions that respect the symmetry of Ω = R²/Γ: periodic and even, by construction.

The lattice is 2Z x 2Z. On the orbifold, a function φ of R²/Γ has φ(x + 2k) = φ(x) = φ(-x).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

_Pair = tuple[int, int]


def _tap_weights(f: Tensor) -> tuple[Tensor, Tensor]:
    """The three weights (..., 3) of the uniform quadratic B-spline at f in [0, 1), and slopes."""
    s = 1 - f
    return (
        torch.stack([0.5 * s * s, 0.5 + f * s, 0.5 * f * f], dim=-1),
        torch.stack([-s, s - f, f], dim=-1),
    )


class PeriodicSplineGrid(nn.Module):
    """Multi-resolution periodic grids of trainable features, blended by quadratic B-splines.

    A C¹ function of the torus R²/(2Z)², and an encoding in the sense of
    :mod:`nsm.maps.encodings`.

    Args:
        resolutions: cells along both axes, (N₁, N₂) or one number, of each level.
        features: of each level; ``out_dim`` is their sum.
        scale: standard deviation of the entries at the start.
    """

    def __init__(
        self,
        resolutions: Sequence[int | _Pair] = (4, 8, 16, 32, 64),
        features: int = 2,
        scale: float = 0.0,
    ) -> None:
        super().__init__()
        self.resolutions: list[_Pair] = [
            (r, r) if isinstance(r, int) else (int(r[0]), int(r[1])) for r in resolutions
        ]
        self.features, self.out_dim = features, features * len(self.resolutions)
        self.tables = nn.ParameterList(
            nn.Parameter(scale * torch.randn(n * m, features)) for n, m in self.resolutions
        )

    def _taps(self, x: Tensor, size: _Pair) -> tuple[Tensor, Tensor, Tensor]:
        """Rows (..., 3, 3) of a table that points (..., 2) see, weights (..., 2, 3), slopes."""
        count = torch.tensor(size, device=x.device)
        turns = 0.5 * x
        t = (turns - torch.floor(turns)) * count.to(x.dtype)
        cell = torch.floor(t)
        weights, slopes = _tap_weights(t - cell)
        index = cell.long()[..., None] + torch.arange(-1, 2, device=x.device)
        index = torch.remainder(index, count[:, None])
        rows = index[..., 0, :, None] * size[1] + index[..., 1, None, :]
        return rows, weights, slopes * (0.5 * count.to(x.dtype))[:, None]

    def forward(self, x: Tensor) -> Tensor:
        """Points (..., 2) to features (..., out_dim)."""
        parts = []
        for size, table in zip(self.resolutions, self.tables, strict=True):
            rows, w, _ = self._taps(x, size)
            blend = w[..., 0, :, None] * w[..., 1, None, :]
            parts.append((table[rows] * blend[..., None]).sum(dim=(-3, -2)))
        return torch.cat(parts, dim=-1)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Features (..., out_dim) and their Jacobian (..., out_dim, 2)."""
        stack = self.value_and_jacobian_stack(x)
        return stack[0], torch.stack([stack[1], stack[2]], dim=-1)

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, ..., out_dim)."""
        parts = []
        for size, table in zip(self.resolutions, self.tables, strict=True):
            rows, w, d = self._taps(x, size)
            u, v = w[..., 0, :, None], w[..., 1, None, :]
            blend = torch.stack([u * v, d[..., 0, :, None] * v, u * d[..., 1, None, :]])
            parts.append((table[rows] * blend[..., None]).sum(dim=(-3, -2)))
        return torch.cat(parts, dim=-1)

    def refined(self) -> PeriodicSplineGrid:
        """The same function on grids of twice the resolution (two-scale relation, ¾ and ¼)."""
        new = PeriodicSplineGrid([(2 * n, 2 * m) for n, m in self.resolutions], self.features)
        with torch.no_grad():
            for (n, m), old, table in zip(self.resolutions, self.tables, new.tables, strict=True):
                fine = old.view(n, m, -1)
                for axis in (0, 1):
                    left = 0.75 * fine + 0.25 * fine.roll(1, axis)
                    right = 0.75 * fine + 0.25 * fine.roll(-1, axis)
                    fine = torch.stack([left, right], dim=axis + 1).flatten(axis, axis + 1)
                table.data = fine.reshape(-1, self.features).clone()
        return new


def _value_and_jacobian(function: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """(..., d) and (..., d, 2) at points x (..., 2), by forward mode unless it has its own."""
    own = getattr(function, "value_and_jacobian", None)
    if own is not None:
        value, jacobian = own(x)
        return value, jacobian
    columns = []
    for k in range(2):
        tangent = torch.zeros_like(x)
        tangent[..., k] = 1
        value, column = torch.func.jvp(function, (x,), (tangent,))[:2]
        columns.append(column)
    return value, torch.stack(columns, dim=-1)


class Even(nn.Module):
    """g(x) + g(-x): an even encoding from any other, periodic if that is.

    Args:
        encoding: module from (..., 2) to (..., encoding.out_dim).
    """

    def __init__(self, encoding: nn.Module) -> None:
        super().__init__()
        self.encoding = encoding
        self.out_dim: int = encoding.out_dim  # type: ignore[assignment]

    def forward(self, x: Tensor) -> Tensor:
        value: Tensor = self.encoding(x) + self.encoding(-x)
        return value

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(..., out_dim) and (..., out_dim, 2)."""
        here, by_here = _value_and_jacobian(self.encoding, x)
        there, by_there = _value_and_jacobian(self.encoding, -x)
        return here + there, by_here - by_there

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, ..., out_dim)."""
        value, jacobian = self.value_and_jacobian(x)
        return torch.stack([value, jacobian[..., 0], jacobian[..., 1]])


class EvenMap(nn.Module):
    """φ(x) = N(g(x) + g(-x)): a closed surface of genus 0, without a seam, on the orbifold 2222.

    Its Jacobian is zero at the four cones: leave small discs around them out of pointwise energies.

    Args:
        encoding: g, periodic, such as :class:`PeriodicSplineGrid`.
        network: N, a module of features; the features themselves if None.
    """

    def __init__(self, encoding: nn.Module, network: nn.Module | None = None) -> None:
        super().__init__()
        self.even = Even(encoding)
        self.network = network

    def forward(self, x: Tensor) -> Tensor:
        """Points (..., 2) to points of the surface."""
        features: Tensor = self.even(x)
        return features if self.network is None else self.network(features)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., d) and Jacobians (..., d, 2)."""
        features, jacobian = self.even.value_and_jacobian(x)
        if self.network is None:
            return features, jacobian
        columns = []
        for k in range(2):
            value, column = torch.func.jvp(self.network, (features,), (jacobian[..., k],))[:2]
            columns.append(column)
        return value, torch.stack(columns, dim=-1)
