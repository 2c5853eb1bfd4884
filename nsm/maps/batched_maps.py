"""Several maps evaluated in one batch, each at its own points.

On a device that one small network does not fill, k networks then cost about as much as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from nsm.maps import bsplines
from nsm.maps.composition import LatticeAligned, PointMap, Rotated
from nsm.maps.encodings import value_and_jacobian_stack
from nsm.maps.mlp_with_tangents import MLPWithTangents
from nsm.maps.networks import SKIPS, NeuralMap, add_linear_skip
from nsm.maps.planar import IdentityInitializedMap
from nsm.maps.spline_field import SplineField
from nsm.maps.tabulated import Tabulated
from nsm.tensors import transformed


class BatchedNetworks(nn.Module):
    """k networks of the same configuration, each with its own weights.

    Args:
        networks: k of them.
    """

    def __init__(self, networks: Sequence[NeuralMap]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, x: Tensor) -> Tensor:
        """(k, N, 2) points, N for each network, to (k, N, out_dim)."""
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(k, N, 2) to the values (k, N, out_dim) and Jacobians (k, N, out_dim, 2)."""
        networks = cast(Sequence[NeuralMap], self.networks)
        if transformed():
            return OneByOne(networks).value_and_jacobian(x)
        parameters = zip(
            *([p for m in n.layers for p in (m.weight, m.bias)] for n in networks), strict=True
        )
        features = self._encoded(x)
        stack = MLPWithTangents.apply(
            features,
            networks[0].activation,
            SKIPS[networks[0].config["block"]],
            torch.is_grad_enabled(),
            *(torch.stack(same) for same in parameters),
        )
        linear = [n.linear_skip for n in networks if n.linear_skip is not None]
        if linear:
            weight, bias = (
                torch.stack(w) for w in zip(*((m.weight, m.bias) for m in linear), strict=True)
            )
            stack = add_linear_skip(stack, features, weight, bias)
        return stack[:, 0], stack[:, 1:].permute(0, 2, 3, 1)

    def _encoded(self, x: Tensor) -> Tensor:
        each = zip((cast(NeuralMap, network).encoding for network in self.networks), x, strict=True)
        return torch.stack([value_and_jacobian_stack(e, points) for e, points in each])


class OneByOne(nn.Module):
    """k maps of any kind, evaluated one after the other.

    Args:
        maps: k of them, with images of one dimension.
    """

    def __init__(self, maps: Sequence[nn.Module]) -> None:
        super().__init__()
        self.maps = nn.ModuleList(maps)

    def forward(self, x: Tensor) -> Tensor:
        """(k, N, 2) points, N for each map, to (k, N, n)."""
        return torch.stack([m(points) for m, points in zip(self.maps, x, strict=True)])

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(k, N, 2) to the values (k, N, n) and Jacobians (k, N, n, 2)."""
        each = [
            cast(PointMap, m).value_and_jacobian(points)
            for m, points in zip(self.maps, x, strict=True)
        ]
        values, jacobians = zip(*each, strict=True)
        return torch.stack(values), torch.stack(jacobians)


class BatchedSplines(OneByOne):
    """k splines on one grid, each with its own coefficients.

    On the CPU they are evaluated one after the other, by compiled loops; elsewhere in one batch.

    Args:
        maps: k of them, for which :func:`_spline` has a grid, the same one.
    """

    def forward(self, x: Tensor) -> Tensor:
        """(k, N, 2) points, N for each spline, to (k, N, n)."""
        if x.device.type == "cpu":
            return super().forward(x)
        return self._stack(x, tangents=False)[0]

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(k, N, 2) to the values (k, N, n) and Jacobians (k, N, n, 2)."""
        if x.device.type == "cpu":
            return super().value_and_jacobian(x)
        stack = self._stack(x, tangents=True)
        return stack[0], stack[1:].permute(1, 2, 3, 0)

    def _stack(self, x: Tensor, tangents: bool) -> Tensor:
        grids, tables = zip(*(_spline(m) for m in self.maps), strict=True)
        return bsplines.read_each(x.to(tables[0].dtype), grids[0], tables, tangents)


def _spline(map: nn.Module) -> tuple[bsplines.Grid, Tensor] | tuple[None, None]:
    """The grid and the coefficients (rows, n) of a map that is one spline; None: it is not."""
    if isinstance(map, SplineField):
        return map.grids[0], map.coefficients
    if isinstance(map, Tabulated):
        return map.grid.grids[0], map.grid.tables[0]
    return None, None


def batched(maps: Sequence[nn.Module]) -> Any:
    """One map of points (k, N, 2), N for each of k maps.

    Networks, splines, planar maps and rotated ones that differ in their weights alone are evaluated
    in one batch; any others one after the other. Gradients go to the weights of each.

    Args:
        maps: k of them, with images of one dimension.

    Returns:
        A module with ``value_and_jacobian``.
    """
    first = maps[0]
    if isinstance(first, (Rotated, LatticeAligned)) and all(type(m) is type(first) for m in maps):
        turned = cast(Sequence[Any], maps)
        return type(first).all_of(turned, batched([m.inner for m in turned]))
    if all(type(m) is type(first) for m in maps):
        if isinstance(first, IdentityInitializedMap):
            inner = [cast(IdentityInitializedMap, m).network for m in maps]
            return type(first).around(batched(inner))
        if isinstance(first, NeuralMap) and first.fused:
            networks = cast(Sequence[NeuralMap], maps)
            if all(m.config == first.config for m in networks):
                return BatchedNetworks(networks)
    grid = _spline(first)[0]
    if grid is not None and all(_spline(m)[0] == grid for m in maps):
        return BatchedSplines(maps)
    return OneByOne(maps)
