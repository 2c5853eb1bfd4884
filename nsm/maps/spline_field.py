"""A planar spline whose coefficients are all that it has: what quasi-Newton steps train."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from nsm.instantiation import target_of
from nsm.maps.at_points import AtPoints
from nsm.maps.encodings import _bspline, transformed

_DEGREE = 2
_TAPS = (_DEGREE + 1) ** 2
_FEW = 4096  # points of a set
# points whose weights are kept: of small sets, and of large ones, ordered for the gradient
_KEPT, _KEPT_ORDERED = 1 << 16, 1 << 18


class _Weights:
    """What a set of points sees of the coefficients: value and both tangents are a matrix product
    with them, W c, and the gradient is the transposed product, both as sums over short rows.

    Args:
        rows: (N, 9) of the coefficients.
        weights: (P, N, 9), of the value and perhaps the tangents.
        count: of all rows.
    """

    def __init__(self, rows: Tensor, weights: Tensor, count: int) -> None:
        self.rows = rows.repeat(len(weights), 1)
        self.weights = weights.flatten(0, 1)
        place, order = self.rows.flatten().sort(stable=True)
        self.of = order // _TAPS  # the entry of W c that each weight belongs to
        self.turned = self.weights.flatten()[order]
        self.starts = torch.searchsorted(place, torch.arange(count, device=rows.device))


class _ProductOnce(torch.autograd.Function):
    """W c for few points: their shares of the gradient are added up as they come."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
        """(count, d), (N, 9), (P, N, 9) to (P · N, d)."""
        ctx.save_for_backward(rows, weights)
        ctx.count = len(coefficients)
        return _sums(coefficients, rows.repeat(len(weights), 1), weights.flatten(0, 1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        rows, weights = ctx.saved_tensors
        # points innermost: long rows for the processor
        planes = zip(
            weights.transpose(1, 2).contiguous(),
            gradient.view(*weights.shape[:2], gradient.shape[1]).transpose(1, 2).contiguous(),
            strict=True,
        )
        w, g = next(planes)
        shares = w * g[:, None]
        for w, g in planes:
            shares.addcmul_(w, g[:, None])  # (d, 9, N)
        total = gradient.new_zeros(len(shares), ctx.count)
        total.scatter_add_(1, rows.t().flatten().expand(len(total), -1), shares.flatten(1))
        return total.t(), None, None


class _Product(torch.autograd.Function):
    """W c, whose gradient by c is the product with the transposed matrix."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, weights: _Weights) -> Tensor:
        """(rows, d) to (P · N, d)."""
        ctx.of = weights
        return _sums(coefficients, weights.rows, weights.weights)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        w = ctx.of
        return _sums(gradient.contiguous(), w.of, w.turned, w.starts), None


def _sums(table: Tensor, rows: Tensor, weights: Tensor, starts: Tensor | None = None) -> Tensor:
    return nn.functional.embedding_bag(
        rows, table, offsets=starts, mode="sum", per_sample_weights=weights
    )


class SplineField(nn.Module):
    """One uniform quadratic B-spline on [-1, 1]²: linear in its coefficients, zero at the start.

    What points see of the coefficients is kept, in case they come again.

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
        self._few, self._many = AtPoints(_KEPT), AtPoints(_KEPT_ORDERED)
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
        cells = self.cells
        z = (x.t() + 1) * (0.5 * cells)
        cell = z.detach().floor()
        if not self.periodic:
            cell = cell.clamp(0, cells - 1)
        free = z - cell
        offset = free.clamp(0, 1)
        w, slopes, _ = (torch.stack(order, dim=-1) for order in _bspline(offset, _DEGREE))
        along = cell.long()[..., None] + torch.arange(_DEGREE + 1, device=x.device)
        if self.periodic:
            along = (along - 1).remainder(cells)
        rows = along[0, :, :, None] * self.side + along[1, :, None, :]
        orders = [(w[0], w[1])]
        if tangents:  # beyond the rim nothing changes
            d = slopes * ((offset == free) * (0.5 * cells))[..., None]
            orders += [(d[0], w[1]), (w[0], d[1])]
        weights = torch.stack([u[:, :, None] * v[:, None, :] for u, v in orders])
        if self.odd:  # the second half of the coefficients is the first, turned and negative
            turned = rows >= self.side**2 // 2
            rows = torch.where(turned, self.side**2 - 1 - rows, rows)
            weights = torch.where(turned, -weights, weights)
        return rows.flatten(1), weights.flatten(2)

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
            rows, weights = self.seen(points, tangents)
            out = _sums(self.coefficients.detach(), rows.repeat(planes, 1), weights.flatten(0, 1))
            out = out.view(planes, len(points), -1).requires_grad_()
            self._watched.append((points, out))
        elif points.requires_grad or transformed() or torch.compiler.is_compiling():
            rows, weights = self.seen(points, tangents)
            out = (weights[..., None] * self.coefficients[rows]).sum(dim=-2)
        elif len(points) > _FEW and torch.is_grad_enabled() and self.coefficients.requires_grad:
            count = len(self.coefficients)
            ordered = self._many.get(
                points, lambda: _Weights(*self.seen(points, tangents), count), tangents
            )
            out = _Product.apply(self.coefficients, ordered)
        elif len(points) > _FEW:
            out = _ProductOnce.apply(self.coefficients, *self.seen(points, tangents))
        else:
            known = self._few.get(points, lambda: self.seen(points, tangents), tangents)
            out = _ProductOnce.apply(self.coefficients, *known)
        return out.view(planes, *x.shape[:-1], self.out_dim)

    def forward(self, x: Tensor) -> Tensor:
        """Points (..., 2) to values (..., out_dim)."""
        return self._evaluated(x, tangents=False)[0]

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Points (..., 2) to values (..., out_dim) and Jacobians (..., out_dim, 2)."""
        stack = self._evaluated(x, tangents=True)
        return stack[0], torch.stack([stack[1], stack[2]], dim=-1)
