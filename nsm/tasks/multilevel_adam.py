"""Adam in the coordinates of a spline's levels: a step of a coarse one moves all around it."""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
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

    def changes(
        self,
        gradients: Sequence[Tensor],
        states: Sequence[MutableMapping[str, Any]],
        step: int,
        lr: float,
    ) -> Sequence[Tensor]:
        """What a step adds to the coefficients of splines alike, in one batch.

        Args:
            gradients: (rows, d) by the coefficients of each.
            states: of the optimizer; a level's moments are ``moments_NUMBER`` (2, d, n, m), and
                after the call those of this step.
            step: from 0.
            lr: the rate.
        """
        count = len(gradients)
        of_levels = [self.two_scale.table(_joined(gradients, 1))]  # (count · d, n, m)
        while len(of_levels) < len(self.scales):
            of_levels.insert(0, self.two_scale.transposed(of_levels[0]))
        of_levels = [scale * g for scale, g in zip(self.scales, of_levels, strict=True)]
        # one bad sample would be remembered in the moments for long
        norms = torch.stack([own.norm() for g in of_levels for own in g.chunk(count)])
        norm = norms.view(-1, count).norm(dim=0)
        clip = (self.largest / norm.clamp(min=1e-30)).clamp(max=1.0)
        clip = clip[:, None].expand(-1, len(of_levels[0]) // count).reshape(-1, 1, 1)
        total: Tensor | None = None
        for number, (g, scale) in enumerate(zip(of_levels, self.scales, strict=True)):
            key, shape = f"moments_{number}", (len(g) // count, *g.shape[1:])
            moments = _joined([self._moments(state, key, g, shape) for state in states], 1)
            for state, part in zip(states, moments.split(shape[0], dim=1), strict=True):
                state[key] = part
            first, second, g = *moments, clip * g
            first.lerp_(g, 1 - self.betas[0])
            second.lerp_(g.square(), 1 - self.betas[1])
            unbiased = [1 - beta ** (step + 1) for beta in self.betas]
            root = (second / unbiased[1]).sqrt_().add_(self.eps)
            own = first / root * (-lr * scale / unbiased[0])
            total = own if total is None else self.two_scale.refined(total) + own
        assert total is not None
        return self.two_scale.rows(total).split(len(total) // count, dim=1)

    @staticmethod
    def _moments(
        state: MutableMapping[str, Any], key: str, like: Tensor, shape: tuple[int, ...]
    ) -> Tensor:
        if key not in state:
            return like.new_zeros(2, *shape)
        moments: Tensor = state[key]
        if moments.dim() == 3:  # (2, rows, d) of an earlier version's checkpoint
            return moments.mT.reshape(2, *shape)
        return moments


def _joined(parts: Sequence[Tensor], dim: int) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts), dim=dim)


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
