"""A planar spline whose coefficients are all that it has: what quasi-Newton steps train."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from nsm.instantiation import target_of
from nsm.maps import bsplines

_DEGREE = 2


class SplineField(nn.Module):
    """One uniform quadratic B-spline on [-1, 1]²: linear in its coefficients, zero at the start.

    Args:
        out_dim: of the values.
        cells: along each axis.
        periodic: on the torus R²/(2Z)²; else points outside the square count as the nearest in it.
        odd: n(-x) = -n(x), of a periodic one of an even number of cells.

    Attributes:
        coefficients: (rows, ``out_dim``): side² of them, side = cells + 2, or cells if periodic;
            if odd, half of them.

    Raises:
        ValueError: a parameter is out of range.
    """

    def __init__(
        self, out_dim: int = 2, cells: int = 8, periodic: bool = False, odd: bool = False
    ) -> None:
        super().__init__()
        if out_dim < 1 or cells < 3:
            raise ValueError("map.cells must be 3 or more, and out_dim positive")
        if odd and (cells % 2 or not periodic):
            raise ValueError("an odd spline is periodic; map.cells must be even")
        self.periodic, self.odd = bool(periodic), bool(odd)
        self.out_dim, self.cells = int(out_dim), int(cells)
        rows = self.side**2 // (2 if odd else 1)
        self.coefficients = nn.Parameter(torch.zeros(rows, out_dim))
        kind = bsplines.PERIODIC if periodic else bsplines.CLAMPED
        grid = bsplines.Grid((cells, cells), 1.0, _DEGREE, bsplines.ODD if odd else kind)
        self.grids = (grid,)
        self._watched: list[tuple[Tensor, Tensor]] | None = None

    @property
    def side(self) -> int:
        """Coefficients along each axis."""
        return self.cells if self.periodic else self.cells + _DEGREE

    @property
    def config(self) -> dict[str, Any]:
        """Settings from which :func:`nsm.maps.build_stored` makes it again."""
        return {
            "_target_": target_of(type(self)).replace("nsm.maps.spline_field.", "nsm.maps."),
            "out_dim": self.out_dim,
            "cells": self.cells,
            "periodic": self.periodic,
            "odd": self.odd,
        }

    def seen(self, x: Tensor, tangents: bool) -> tuple[Tensor, Tensor]:
        """What points (N, 2) see of the coefficients.

        Returns:
            Rows (N, 9), and their weights (P, N, 9) for the value and, with ``tangents``, for both
            derivatives: P is 1 or 3.
        """
        rows, weights = bsplines.seen(x, self.grids[0])
        return rows, weights[: 3 if tangents else 1]

    @contextmanager
    def watched(self) -> Iterator[list[tuple[Tensor, Tensor]]]:
        """Gather what is evaluated: points (N, 2), and their values with both tangents (3, N,
        out_dim), from which gradients are wanted instead of from the coefficients."""
        self._watched = []
        try:
            yield self._watched
        finally:
            self._watched = None

    def _evaluated(self, x: Tensor, tangents: bool) -> Tensor:
        """Value and perhaps both tangents at points (..., 2): (P, ..., out_dim)."""
        points = x.reshape(-1, 2).to(self.coefficients.dtype)
        planes = 3 if tangents else 1
        if self._watched is not None:
            out = self._read(points, self.coefficients.detach(), tangents).requires_grad_()
            self._watched.append((points, out))
        else:
            out = self._read(points, self.coefficients, tangents)
        return out.view(planes, *x.shape[:-1], self.out_dim)

    def _read(self, points: Tensor, coefficients: Tensor, tangents: bool) -> Tensor:
        """(P, N, out_dim) at points (N, 2)."""
        by_points = points.requires_grad  # which may be differentiated twice
        read = bsplines.read_plainly if by_points else bsplines.read
        return read(points, self.grids, [coefficients], tangents)

    def forward(self, x: Tensor) -> Tensor:
        """Points (..., 2) to values (..., out_dim)."""
        return self._evaluated(x, tangents=False)[0]

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., 2) to values (..., out_dim) and Jacobians (..., out_dim, 2)."""
        stack = self._evaluated(x, tangents=True)
        return stack[0], torch.stack([stack[1], stack[2]], dim=-1)
