"""A periodic spline as a sum of levels from coarse to fine, odd on the orbifold."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.instantiation import target_of
from nsm.maps.lattice_grid import LatticeSplineGrid
from nsm.maps.two_scale import level_cells, level_scale, refined


class MultilevelSpline(nn.Module):
    """n(x) = Σ n_l(x) on R²/(2Z)², uniform quadratic B-splines; zero at the start.

    Each level has twice the cells of the one before, so that the sum is one spline on the finest
    grid (two-scale relation): points see nine coefficients, whatever the number of levels. What
    these are for is the training, where a step of a coarse level moves all around it.

    Args:
        out_dim: of the values.
        cells: of the finest level along each axis, even.
        odd: whether n(-x) = -n(x). The coefficients are then made odd, and n is evaluated once.

    Raises:
        ValueError: a parameter is out of range.
    """

    def __init__(self, out_dim: int = 2, cells: int = 128, odd: bool = False) -> None:
        super().__init__()
        if out_dim < 1 or cells < 4 or cells % 2:
            raise ValueError("map.cells must be even and 4 or more, and out_dim positive")
        self.out_dim, self.cells, self.odd = int(out_dim), int(cells), bool(odd)
        self.tables = nn.ParameterList(
            nn.Parameter(torch.zeros(n, n, self.out_dim)) for n in level_cells(self.cells)
        )
        self._finest = LatticeSplineGrid([(self.cells, self.cells)], self.out_dim)
        self._finest.tables = nn.ParameterList()

    @property
    def config(self) -> dict[str, Any]:
        """Settings from which :func:`nsm.maps.build_stored` makes it again."""
        return {
            "_target_": target_of(type(self)).replace(".multilevel_spline.", "."),
            "out_dim": self.out_dim,
            "cells": self.cells,
            "odd": self.odd,
        }

    def coefficients(self) -> Tensor:
        """(cells², ``out_dim``) of the sum of all levels, on the finest grid."""
        levels = [level_scale(len(table)) * table for table in self.tables]
        c = levels[0]
        for finer in levels[1:]:
            c = refined(refined(c, 0), 1) + finer
        if self.odd:
            c = 0.5 * (c - c.flip(0, 1))  # x → -x takes cell i to cells - 1 - i
        return c.flatten(0, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Points (..., 2) to values (..., ``out_dim``)."""
        return self._read(x, tangents=False)[0]

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., 2) to values (..., ``out_dim``) and Jacobians (..., ``out_dim``, 2)."""
        value, along, across = self._read(x, tangents=True)
        return value, torch.stack([along, across], dim=-1)

    def _read(self, x: Tensor, tangents: bool) -> Tensor:
        """(P, ..., ``out_dim``) at points (..., 2)."""
        stack = self._finest.blended(x.reshape(-1, 2), [self.coefficients()], tangents)
        return stack.view(len(stack), *x.shape[:-1], self.out_dim)
