"""Spline grids on closed domains R²/Γ: periodic, and even on the orbifold, by construction."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nsm.maps import bsplines
from nsm.maps.bsplines import basis
from nsm.maps.encodings import SplineGrid, _config

_DEGREE = 2
_TAPS = torch.arange(-1, 2)


def into_domain(x: Tensor, even: bool) -> tuple[Tensor, Tensor]:
    """Points moved by Γ into the fundamental domain, differentiable.

    Args:
        x: (2, N) in any lift.
        even: whether x ↦ -x is in Γ, beside the translations by 2e₁ and 2e₂.

    Returns:
        (2, N) in [-1, 1]², in its upper half if ``even``; and signs (N,), -1 for points that were
        turned.
    """
    y = x - 2 * torch.round(x / 2)
    sign = torch.ones_like(y[0])
    if even:
        turned = (y[1] < 0) | ((y[1] == 0) & (y[0] < 0))
        sign = torch.where(turned, -sign, sign).detach()
        y = sign * y
    return y, sign


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

    def rows_of(self, i: Tensor, j: Tensor, cells: Tensor) -> Tensor:
        """Rows (...) of a table for coefficients (i, j), any integers (...), of a grid of cells
        (..., 2)."""
        return self._rows(
            torch.remainder(i, cells[..., 0]), torch.remainder(j, cells[..., 1]), cells
        )

    def _rows(self, i: Tensor, j: Tensor, cells: Tensor) -> Tensor:
        """As :meth:`rows_of`, of coefficients in one period."""
        n, m = cells[..., 0], cells[..., 1]
        if not self.even:
            return i * m + j
        # x → -x takes (i, j) to (N₁ - 1 - i, N₂ - 1 - j): the upper half stands for both
        half = m // 2
        low, above = j < half, i * half
        return torch.where(low, (n - 1) * half - above, above) + torch.where(
            low, half - 1 - j, j - half
        )

    def cell_rows(self, level: int) -> Tensor:
        """Rows (rows, 9) that the points of each cell of Ω see; the cell of row r is number r."""
        n, m = self.cells(level)
        i, j = torch.meshgrid(
            torch.arange(n), torch.arange(m // 2 if self.even else 0, m), indexing="ij"
        )
        i, j = i.reshape(-1, 1, 1) + _TAPS[:, None], j.reshape(-1, 1, 1) + _TAPS
        return self.rows_of(i, j, torch.tensor([n, m])).flatten(1)

    def _seen(
        self, x: Tensor, resolutions: Sequence[int] | None = None
    ) -> tuple[Tensor, list[list[Tensor]]]:
        """As :meth:`SplineGrid._seen`."""
        cells = torch.tensor(resolutions or self.resolutions, device=x.device)  # (L, 2)
        y, sign = into_domain(x.t(), self.even)
        size = cells[:, :, None].to(x.dtype)
        z = (y + 1) * (0.5 * size)
        cell = z.detach().floor().clamp(min=0).minimum(size - 1)
        weights, slopes, bends = basis(z - cell, _DEGREE)
        corner, side = cell.long(), cells[:, :, None]
        # the cell itself and those beside it, around the period; cheaper than remainders
        before = torch.where(corner == 0, side, corner) - 1
        after = torch.where(corner == side - 1, 0, corner + 1)
        taps = torch.stack([before, corner, after], dim=2)
        rows = self._rows(taps[:, 0, :, None], taps[:, 1, None], cells[:, None, None, None])
        rate = 0.5 * size * sign
        scaled = [[w * rate for w in slopes], [w * rate * rate for w in bends]]
        return rows.flatten(1, 2), [weights, *scaled]

    @property
    def grids(self) -> list[bsplines.Grid]:
        """Of each level."""
        kind = bsplines.EVEN if self.even else bsplines.PERIODIC
        return [bsplines.Grid((n, m), 1.0, _DEGREE, kind) for n, m in self._cells]

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        return self.blended(x, list(self.tables), tangents=True)

    def forward(self, x: Tensor) -> Tensor:
        """Points (N, 2) in any lift to features (N, out_dim)."""
        return self.blended(x, list(self.tables), tangents=False)[0]
