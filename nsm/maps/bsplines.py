"""Uniform B-splines on grids of the plane, read at points.

A grid's coefficients are the rows of a table (rows, F). A point sees (degree + 1)² of them; the
value and the derivatives there are sums of these with products of weights along the two axes. On
the CPU compiled loops read all at once, as each of some seventy operations on tensors would take
longer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsm.maps import compiled_bsplines as loops
from nsm.maps.compiled_bsplines import CLAMPED, EVEN, ODD, PERIODIC
from nsm.tensors import suit_compiled

__all__ = [
    "CLAMPED",
    "EVEN",
    "ODD",
    "PERIODIC",
    "Grid",
    "into_domain",
    "read",
    "read_each",
    "read_plainly",
    "rows_of",
    "seen",
]


class Grid(NamedTuple):
    """A uniform grid over [-half, half]².

    Attributes:
        cells: (N₁, N₂) along the two axes.
        half: half the side of the square.
        degree: 2 or 3; 2 unless ``symmetry`` is CLAMPED.
        symmetry: CLAMPED, points outside the square count as the nearest in it, and rows are
            i · (N₂ + degree) + j; PERIODIC, rows are i · N₂ + j; EVEN, x and -x are one point, and
            the rows of the upper half stand for both; ODD, f(-x) = -f(x), and the first half of
            the rows stands for both. But for CLAMPED ones, half is 1.
    """

    cells: tuple[int, int]
    half: float
    degree: int
    symmetry: int


def read(x: Tensor, grids: Sequence[Grid], tables: Sequence[Tensor], tangents: bool) -> Tensor:
    """Splines at points: on the CPU by compiled loops, differentiable once; elsewhere, and under
    transforms, as :func:`read_plainly`.

    Args:
        x: (N, 2).
        grids: L of them.
        tables: L of coefficients, (rows, F_l), of one type.
        tangents: whether the derivatives along both axes are wanted, too.

    Returns:
        (P, N, ΣF_l), P = 1, or 3 with ``tangents``, in the type of the tables.
    """
    if not suit_compiled(x, *tables):
        return read_plainly(x, grids, tables, tangents)
    out: Tensor = _Read.apply(x, tuple(grids), tangents, torch.is_grad_enabled(), *tables)
    return out


def read_plainly(
    x: Tensor, grids: Sequence[Grid], tables: Sequence[Tensor], tangents: bool
) -> Tensor:
    """As :func:`read`, by operations that all devices and transforms know, and that are
    differentiable again and again."""
    parts = []
    for grid, table in zip(grids, tables, strict=True):
        rows, weights = _seen_plainly(x, grid)
        parts.append(_weighted(table, rows, weights, tangents))
    return torch.cat(parts, dim=-1)


def read_each(x: Tensor, grid: Grid, tables: Sequence[Tensor], tangents: bool) -> Tensor:
    """Splines on one grid, each at its own points, in one batch: operations as those of
    :func:`read_plainly`.

    Args:
        x: (k, N, 2).
        grid: of all of them.
        tables: k of coefficients, (rows, F), of one type.
        tangents: whether the derivatives along both axes are wanted, too.

    Returns:
        (P, k, N, F), P = 1, or 3 with ``tangents``.
    """
    rows, weights = _seen_plainly(x.flatten(0, 1), grid)
    first = len(tables[0]) * torch.arange(len(tables), device=x.device)
    rows = (rows.view(len(tables), -1) + first[:, None]).view(rows.shape)
    return _weighted(torch.cat(list(tables)), rows, weights, tangents).unflatten(1, x.shape[:2])


def _weighted(table: Tensor, rows: Tensor, weights: Tensor, tangents: bool) -> Tensor:
    """Sums (P, N, F) of the rows (N, k²) of a table, with weights (3, N, k²)."""
    # not an embedding, whose backward pass sorts
    entries = table.index_select(0, rows.flatten()).view(*rows.shape, table.shape[1])
    return (weights[: 3 if tangents else 1, ..., None] * entries).sum(dim=2)


def seen(x: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """What points see of a grid's table, which its values are linear in.

    Args:
        x: (N, 2).
        grid: the grid.

    Returns:
        Rows (N, k²) of the table, k = degree + 1; and their weights (3, N, k²) in the value and in
        both tangents.
    """
    if x.requires_grad or not suit_compiled(x):
        return _seen_plainly(x, grid)
    taps = (grid.degree + 1) ** 2
    rows = torch.empty(len(x), taps, dtype=torch.int64)
    weights = torch.empty(3, len(x), taps, dtype=x.dtype)
    loops.all_seen(x.contiguous().numpy(), *_numbers(grid), rows.numpy(), weights.numpy())
    return rows, weights


def _seen_plainly(x: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """As :func:`seen`, by operations on tensors."""
    periodic, y, sign = grid.symmetry != CLAMPED, x.t(), torch.ones_like(x[:, 0])
    if periodic:
        y, sign = into_domain(y, grid.symmetry == EVEN)
    # not a tensor from the host, whose copy a device waits for
    size = torch.stack([torch.full((1,), cells, device=x.device) for cells in grid.cells])
    rate = size.to(x.dtype) / (2 * grid.half)
    z = (y + grid.half) * rate
    cell = z.detach().floor().nan_to_num(0.0).clamp(min=0).minimum(size.to(x.dtype) - 1)
    free = z - cell
    offset = free.clamp(0, 1)
    within = (offset == free) * rate * sign  # beyond the rim nothing changes
    values, slopes = basis(offset, grid.degree)
    w = torch.stack(values, dim=1)  # (2, k, N)
    d = torch.stack(slopes, dim=1) * within[:, None]
    taps = torch.arange(grid.degree + 1, device=x.device)[:, None]
    along = cell.long()[:, None] + (taps - 1 if periodic else taps)
    if periodic:
        along = along.remainder(size[:, None])
    rows = rows_of(along[0, :, None], along[1, None], grid)
    weights = torch.stack(
        [u[:, None] * v[None] for u, v in ((w[0], w[1]), (d[0], w[1]), (w[0], d[1]))]
    )
    if grid.symmetry == ODD:
        weights = torch.where(rows < 0, -weights, weights)
        rows = torch.where(rows < 0, ~rows, rows)
    return rows.flatten(0, 1).t(), weights.flatten(1, 2).transpose(1, 2)


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


def rows_of(i: Tensor, j: Tensor, grid: Grid) -> Tensor:
    """Rows (...) of a grid's table for coefficients (i, j), (...) each and in one period; ~r for
    row r with the sign turned."""
    n, m = grid.cells
    if grid.symmetry == CLAMPED:
        return i * (m + grid.degree) + j
    if grid.symmetry == EVEN:
        # x → -x takes (i, j) to (N₁ - 1 - i, N₂ - 1 - j): the upper half stands for both
        upper = m // 2
        low = j < upper
        return torch.where(low, n - 1 - i, i) * upper + torch.where(low, upper - 1 - j, j - upper)
    rows = i * m + j
    if grid.symmetry == ODD:
        return torch.where(rows < n * m // 2, rows, ~(n * m - 1 - rows))
    return rows


def basis(t: Tensor, degree: int) -> tuple[list[Tensor], list[Tensor]]:
    """The degree + 1 weights of the uniform B-spline at offset t in [0, 1), and d/dt."""
    s = 1 - t
    if degree == 2:
        return [0.5 * s * s, 0.5 + t * s, 0.5 * t * t], [-s, 1 - 2 * t, t]
    weights = [
        s**3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (3 * s**3 - 6 * s**2 + 4) / 6,
        t**3 / 6,
    ]
    return weights, [-0.5 * s**2, 1.5 * t**2 - 2 * t, 2 * s - 1.5 * s**2, 0.5 * t**2]


class _Read(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        grids: tuple[Grid, ...],
        tangents: bool,
        record: bool,
        *tables: Tensor,
    ) -> Tensor:
        by_x = record and ctx.needs_input_grad[0]
        wanted = 3 if tangents else 1
        planes = {1: 3, 3: 6}[wanted] if by_x else wanted
        width = sum(t.shape[1] for t in tables)
        out = torch.empty(planes, len(x), width, dtype=tables[0].dtype)
        points, image, column = x.detach().contiguous().numpy(), out.numpy(), 0
        for grid, table in zip(grids, tables, strict=True):
            loops.values(points, table.detach().numpy(), *_numbers(grid), image, column)
            column += table.shape[1]
        trained = record and any(ctx.needs_input_grad[4:])
        ctx.save_for_backward(x if trained else None, out[1:] if by_x else None)
        ctx.grids, ctx.shapes, ctx.kind = grids, [t.shape for t in tables], x.dtype
        return out[:wanted]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, derivatives = ctx.saved_tensors
        given = gradient.contiguous().numpy()
        by_x = None
        if derivatives is not None:
            by_x = torch.empty(gradient.shape[1], 2, dtype=ctx.kind)
            loops.by_points(given, derivatives.numpy(), by_x.numpy())
        by_table: list[Tensor | None] = [None] * len(ctx.shapes)
        column = 0
        for level, (grid, shape) in enumerate(zip(ctx.grids, ctx.shapes, strict=True)):
            if x is not None and ctx.needs_input_grad[4 + level]:
                total = gradient.new_zeros(shape)
                loops.by_table(
                    x.contiguous().numpy(), given, *_numbers(grid), total.numpy(), column
                )
                by_table[level] = total
            column += shape[1]
        return (by_x, None, None, None, *by_table)


def _numbers(grid: Grid) -> tuple[int, int, float, tuple[int, ...], int]:
    # how many taps there are is known when the loops are compiled
    return *grid.cells, grid.half, tuple(range(grid.degree + 1)), grid.symmetry
