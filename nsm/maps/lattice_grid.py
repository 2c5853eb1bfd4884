"""Spline grids on closed domains R²/Γ: periodic, and even on the orbifold, by construction."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nsm.maps import bsplines
from nsm.maps.encodings import SplineGrid, _config

_DEGREE = 2
_TAPS = torch.arange(-1, 2)


class LatticeSplineGrid(SplineGrid):
    """Multi-resolution grids on R²/Γ, blended by uniform quadratic B-splines: C¹ everywhere.

    The lattice is 2Z × 2Z. With ``even``, x and -x have the same features too: Γ is then the group
    of the orbifold 2222. Points are moved into the fundamental domain first, so that the lifts of a
    point differ by the rounding of their coordinates only, and tables hold one entry for each orbit
    of coefficients. Unlike :class:`SplineGrid`, the features do not include x, which has no
    symmetry.

    Args:
        resolutions: cells (N₁, N₂) along the two axes of the lattice's cell [-1, 1]², for each
            level; N₂ is even.
        features: of each level.
        even: whether x and -x are one point.

    Raises:
        ValueError: a parameter is out of range.
    """

    def __init__(
        self, resolutions: Sequence[Sequence[int]], features: int = 4, even: bool = False
    ) -> None:
        nn.Module.__init__(self)
        cells = [[int(n) for n in level] for level in resolutions]
        self._cells = cells
        if not cells or any(len(c) != 2 or min(c) < 4 or c[1] % 2 for c in cells):
            raise ValueError("encoding.resolutions needs pairs of 4 cells or more, the second even")
        if features < 1:
            raise ValueError("encoding.features must be positive")
        self.resolutions = cells  # type: ignore[assignment]  # pairs, not one number a level
        self.features, self.degree, self.even = features, _DEGREE, even
        self.config = _config(self, 2, resolutions=cells, features=features, even=even)
        self.tables = nn.ParameterList(
            nn.Parameter(1e-2 * torch.randn(n * m // (2 if even else 1), features))
            for n, m in cells
        )
        self.out_dim = features * len(cells)

    def cells(self, level: int) -> tuple[int, int]:
        """Cells (N₁, N₂) of a level along the two axes."""
        n, m = self._cells[level]
        return n, m

    def rows_of(self, i: Tensor, j: Tensor, cells: tuple[int, int]) -> Tensor:
        """Rows (...) of a table for coefficients (i, j), any integers (...), of a grid of cells
        (N₁, N₂)."""
        grid = self._grid(cells)
        return bsplines.rows_of(torch.remainder(i, cells[0]), torch.remainder(j, cells[1]), grid)

    def _grid(self, cells: tuple[int, int]) -> bsplines.Grid:
        kind = bsplines.EVEN if self.even else bsplines.PERIODIC
        return bsplines.Grid(cells, 1.0, _DEGREE, kind)

    @property
    def grids(self) -> list[bsplines.Grid]:
        """Of each level."""
        return [self._grid((n, m)) for n, m in self._cells]

    def cell_rows(self, level: int) -> Tensor:
        """Rows (rows, 9) that the points of each cell of Ω see; the cell of row r is number r."""
        n, m = self.cells(level)
        i, j = torch.meshgrid(
            torch.arange(n), torch.arange(m // 2 if self.even else 0, m), indexing="ij"
        )
        i, j = i.reshape(-1, 1, 1) + _TAPS[:, None], j.reshape(-1, 1, 1) + _TAPS
        return self.rows_of(i, j, (n, m)).flatten(1)

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        return self.blended(x, list(self.tables), tangents=True)

    def forward(self, x: Tensor) -> Tensor:
        """Points (N, 2) in any lift to features (N, out_dim)."""
        return self.blended(x, list(self.tables), tangents=False)[0]
