"""Adam in the coordinates of a spline's levels: a step of a coarse one moves all around it."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any

import torch
from torch import Tensor

from nsm.maps import SplineField
from nsm.maps.two_scale import FAR, NEAR, level_cells, level_scale, refined


class MultilevelAdam:
    """Adam (Kingma and Ba, 2015) on y, where a spline's coefficients are Σ s_l P_l y_l.

    P_l refines the level l, of half the cells of the next, to the spline's own grid (two-scale
    relation), so that y are coordinates like those of the Sobolev space H¹ (Bramble, Pasciak and
    Xu, 1990). Coefficients are a sum of the levels', so only the moments of y are kept.

    Args:
        field: the spline.
        betas: of the moments.
        eps: beside the root of the second moment.
        largest: norm of the gradient by y; longer ones are shortened.
    """

    def __init__(
        self, field: SplineField, betas: tuple[float, float], eps: float, largest: float
    ) -> None:
        self.betas, self.eps, self.largest = betas, eps, largest
        self.scales = [level_scale(n) for n in level_cells(field.cells, even=field.odd)]
        self.two_scale = TwoScale(field)

    def change(
        self, gradient: Tensor, state: MutableMapping[str, Any], step: int, lr: float
    ) -> Tensor:
        """What a step adds to the coefficients, and the moments after it in the state.

        Args:
            gradient: (rows, d) by the coefficients.
            state: of the optimizer; the moments of each level are ``moments_NUMBER`` (2, d, n, m).
            step: from 0.
            lr: the rate.
        """
        of_levels = [self.two_scale.table(gradient)]
        while len(of_levels) < len(self.scales):
            of_levels.insert(0, self.two_scale.transposed(of_levels[0]))
        of_levels = [scale * g for scale, g in zip(self.scales, of_levels, strict=True)]
        # one bad sample would be remembered in the moments for long
        norm = torch.stack([g.norm() for g in of_levels]).norm()
        clip = (self.largest / norm.clamp(min=1e-30)).clamp(max=1.0)
        total: Tensor | None = None
        for number, (g, scale) in enumerate(zip(of_levels, self.scales, strict=True)):
            first, second = self._moments(state, number, g)
            first.lerp_(clip * g, 1 - self.betas[0])
            second.lerp_((clip * g).square(), 1 - self.betas[1])
            unbiased = [1 - beta ** (step + 1) for beta in self.betas]
            root = (second / unbiased[1]).sqrt_().add_(self.eps)
            own = first / root * (-lr * scale / unbiased[0])
            total = own if total is None else self.two_scale.refined(total) + own
        assert total is not None
        return self.two_scale.rows(total)

    def _moments(self, state: MutableMapping[str, Any], number: int, g: Tensor) -> Tensor:
        key = f"moments_{number}"
        if key not in state:
            state[key] = torch.zeros(2, *g.shape, dtype=g.dtype, device=g.device)
        elif state[key].dim() == 3:  # (2, rows, d) of an earlier version's checkpoint
            state[key] = state[key].mT.reshape(2, *g.shape)
        moments: Tensor = state[key]
        return moments


class TwoScale:
    """The two-scale relation of a spline's tables, and its transpose.

    A table is (d, n, m): n rows and m columns of coefficients for each of d components. An odd
    spline's has half of the rows; those beyond are the same ones, turned and negative.

    Args:
        field: a spline of the same kind, of whatever size.
    """

    def __init__(self, field: SplineField) -> None:
        self.periodic, self.odd, self.side = field.periodic, field.odd, field.side

    def table(self, rows: Tensor) -> Tensor:
        """Coefficients of the spline (rows, d) as its table."""
        return rows.t().reshape(rows.shape[1], -1, self.side)

    def rows(self, table: Tensor) -> Tensor:
        """The inverse of :meth:`table`, of a level (d, n, m): (n · m, d)."""
        return table.flatten(1).t()

    def refined(self, table: Tensor) -> Tensor:
        """The table of the same spline on a grid of twice as many cells a side."""
        for axis in (1, 2):
            table = refined(table, axis, self._widened(table, axis))
            if not self.periodic:  # the square does not see the first and the last
                table = table.narrow(axis, 1, table.shape[axis] - 2)
        return table

    def transposed(self, table: Tensor) -> Tensor:
        """The transpose of :meth:`refined`: from a gradient by the finer table to that by the
        coarser."""
        for axis in (1, 2):
            wide = self._widened(table, axis)
            if not self.periodic:  # the first and the last that refined left out
                wide = self._widened(wide, axis)
            a, b = wide.unflatten(axis, (-1, 2)).unbind(dim=axis + 1)
            count = a.shape[axis] - 1
            before = FAR * a.narrow(axis, 0, count) + NEAR * b.narrow(axis, 0, count)
            table = before + NEAR * a.narrow(axis, 1, count) + FAR * b.narrow(axis, 1, count)
        return table

    def _widened(self, table: Tensor, axis: int) -> Tensor:
        """A table with the rows (axis 1) or columns next beyond its first and last; zeros, if it is
        not periodic."""
        first, last = table.narrow(axis, 0, 1), table.narrow(axis, table.shape[axis] - 1, 1)
        if not self.periodic:
            none = torch.zeros_like(first)
            return torch.cat([none, table, none], dim=axis)
        if self.odd and axis == 1:
            return torch.cat([-first.flip(2), table, -last.flip(2)], dim=1)
        return torch.cat([last, table, first], dim=axis)
