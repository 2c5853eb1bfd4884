"""Surfaces for training: read off a fine spline, or remembered at points that come again."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from scipy.ndimage import spline_filter1d
from torch import Tensor, nn

from nsm.maps import bsplines
from nsm.maps.at_points import AtPoints
from nsm.maps.composition import PointMap
from nsm.maps.encodings import SplineGrid
from nsm.maps.lattice_grid import LatticeSplineGrid

_EXTENT = 1.05  # half the side of the square that a bounded Ω's table covers
_AT_ONCE = 8192
_KEPT = 1 << 18  # points at which Jacobians are remembered


class Tabulated(nn.Module):
    """The quadratic B-spline through a surface's values at the centres of a grid's cells.

    To evaluate it costs a fraction of what a network costs. It stands for the surface while a map
    is trained; figures are measured on the mesh.

    Args:
        surface: φ, (N, 2) to (N, 3), which is not changed.
        cells: along each axis; even.
        periodic: Ω is R²/(2Z)² or a quotient of it; else a part of [-1, 1]².
    """

    def __init__(self, surface: nn.Module, cells: int = 512, periodic: bool = False) -> None:
        super().__init__()
        some = next(iter(surface.parameters()), torch.zeros(()))
        half = 1.0 if periodic else _EXTENT
        rim = 0 if periodic else 1  # coefficients lie at the centres of cells, one beyond the rim
        centres = (np.arange(-rim, cells + rim) + 0.5) * (2 * half / cells) - half
        along = torch.as_tensor(centres).to(some)
        x = torch.cartesian_prod(along, along)
        with torch.no_grad():
            values = torch.cat([surface(part) for part in x.split(_AT_ONCE)])
        table = values.double().cpu().numpy().reshape(len(along), len(along), -1)
        for axis in (0, 1):
            table = spline_filter1d(
                table, order=2, axis=axis, mode="grid-wrap" if periodic else "mirror"
            )
        features = table.shape[-1]
        if periodic:
            self.grid: SplineGrid = LatticeSplineGrid([(cells, cells)], features)
        else:
            self.grid = SplineGrid(resolutions=[cells], features=features, extent=half)
        coefficients = torch.as_tensor(table.reshape(-1, features)).to(some)
        self.grid.tables[0].data = coefficients
        self.requires_grad_(False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 3)."""
        return bsplines.read(x, self.grid.grids, list(self.grid.tables), tangents=False)[0]

    def stack(self, x: Tensor) -> Tensor:
        """Values and both tangents at (N, 2), stacked: (3, N, 3)."""
        return bsplines.read(x, self.grid.grids, list(self.grid.tables), tangents=True)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 3) and Jacobians (N, 3, 2)."""
        stack = self.stack(x)
        return stack[0], stack[1:].permute(1, 2, 0)


class Remembered(nn.Module):
    """A surface that is not trained, and keeps its Jacobians at points that come again.

    Args:
        surface: φ, with ``value_and_jacobian``.
    """

    def __init__(self, surface: nn.Module) -> None:
        super().__init__()
        self.surface = surface
        self._known = AtPoints(_KEPT)

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 3)."""
        value: Tensor = self.surface(x)
        return value

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 3) and Jacobians (N, 3, 2)."""
        if torch.is_grad_enabled():
            return cast(PointMap, self.surface).value_and_jacobian(x)
        surface = cast(PointMap, self.surface)
        return self._known.get(x, lambda: surface.value_and_jacobian(x))
