"""Encodings of the plane: the features of a point (u, v) that a network takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from nsm.errors import NsmError
from nsm.instantiation import target_of


class Encoding(Protocol):
    """A module from points x (N, 2) to features (N, out_dim).

    One without ``value_and_jacobian_stack`` is differentiated by :func:`pushed_forward`.
    """

    out_dim: int
    config: dict[str, Any]

    def __call__(self, x: Tensor) -> Tensor:
        """Points (N, 2) to (N, out_dim); each row depends on its own point alone."""
        ...


def pushed_forward(function: Callable[[Tensor], Tensor], stack: Tensor) -> Tensor:
    """A function of the rows of a tensor, with its tangents, by PyTorch's forward mode.

    Args:
        function: (N, d) to (N, d'); each row depends on its own row alone.
        stack: value and P − 1 tangents of its argument, (P, N, d).

    Returns:
        Value and tangents of the function, (P, N, d'), differentiable as the function is.
    """
    tangents, count = len(stack) - 1, stack.shape[1]
    # all tangents in one call, whose overhead is greater than its arithmetic
    points = stack[0].repeat(tangents, 1)
    value, pushed = torch.func.jvp(function, (points,), (stack[1:].flatten(0, 1),))[:2]
    return torch.cat([value[None, :count], pushed.unflatten(0, (tangents, count))])


def transformed() -> bool:
    """Whether a transform of torch.func is active.

    The operations with a backward pass of their own then give way to plain ones, which all
    transforms know.
    """
    return not torch.compiler.is_compiling() and torch._C._are_functorch_transforms_active()


def as_encoding(given: Any, config: dict[str, Any] | None = None) -> Encoding:
    """A module as an encoding with ``config``.

    Args:
        given: a module from points (N, 2) to features (N, ``out_dim``).
        config: settings with ``_target_`` that make it again; by default, its class.

    Raises:
        NsmError: it has no ``out_dim``.
    """
    if not isinstance(getattr(given, "out_dim", None), int):
        message = "encoding: it needs an attribute out_dim, its number of features"
        raise NsmError(message, kind="wrong_type", key="encoding")
    if not hasattr(given, "config"):
        given.config = dict(config or {"_target_": target_of(type(given))})
    encoding: Encoding = given
    return encoding


def value_and_jacobian_stack(encoding: Encoding, x: Tensor) -> Tensor:
    """Value and both tangents of an encoding at points (N, 2), stacked: (3, N, out_dim)."""
    if hasattr(encoding, "value_and_jacobian_stack"):
        stack: Tensor = encoding.value_and_jacobian_stack(x)
        return stack
    return pushed_forward(encoding, Identity(x.shape[1]).value_and_jacobian_stack(x))


def _config(encoding: nn.Module, in_dim: int, **parameters: Any) -> dict[str, Any]:
    of_input = {} if in_dim == 2 else {"in_dim": in_dim}
    return {"_target_": target_of(type(encoding)), **of_input, **parameters}


class Identity(nn.Module):
    """No encoding: the coordinates themselves.

    Args:
        in_dim: dimension of x.
    """

    def __init__(self, in_dim: int = 2) -> None:
        super().__init__()
        self.out_dim = in_dim
        self.config = _config(self, in_dim)

    def forward(self, x: Tensor) -> Tensor:
        return x

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, 2)."""
        tangents = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)
        return torch.cat([x[None], tangents[:, None, :].expand(-1, x.shape[0], -1)])


class RandomFourierFeatures(nn.Module):
    """x, sin(2πBx), cos(2πBx) with a fixed Gaussian B (Tancik et al., NeurIPS 2020).

    Args:
        in_dim: dimension of x.
        features: rows of B; ``out_dim`` is ``in_dim + 2 * features``.
        sigma: standard deviation of B's entries, in cycles per unit of Ω.

    Raises:
        ValueError: there are no features, or sigma is not positive.
    """

    def __init__(self, in_dim: int = 2, features: int = 64, sigma: float = 2.0) -> None:
        super().__init__()
        if features < 1 or not 0 < sigma < math.inf:
            raise ValueError("encoding.features and encoding.sigma must be positive")
        self.config = _config(self, in_dim, features=features, sigma=sigma)
        self.register_buffer("frequencies", 2 * math.pi * sigma * torch.randn(features, in_dim))
        self.out_dim = in_dim + 2 * features

    frequencies: Tensor

    def forward(self, x: Tensor) -> Tensor:
        z = x @ self.frequencies.T
        return torch.cat([x, torch.sin(z), torch.cos(z)], dim=-1)

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        z = x @ self.frequencies.T
        sine, cosine = torch.sin(z), torch.cos(z)
        value = torch.cat([x, sine, cosine], dim=-1)
        rows = self.frequencies.T[:, None, :]  # (2, 1, features): dz/dx_i
        unit = torch.eye(x.shape[1], dtype=x.dtype, device=x.device)[:, None, :]
        tangents = torch.cat([unit.expand(-1, x.shape[0], -1), rows * cosine, -rows * sine], dim=-1)
        return torch.cat([value[None], tangents])


def _bspline(t: Tensor, degree: int) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """The degree + 1 weights of the uniform B-spline at offset t in [0, 1), d/dt, and d²/dt²."""
    s = 1 - t
    if degree == 2:
        one = torch.ones_like(t)
        weights = [0.5 * s * s, 0.5 + t * s, 0.5 * t * t]
        return weights, [-s, 1 - 2 * t, t], [one, -2 * one, one]
    weights = [
        s**3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (3 * s**3 - 6 * s**2 + 4) / 6,
        t**3 / 6,
    ]
    slopes = [-0.5 * s**2, 1.5 * t**2 - 2 * t, 2 * s - 1.5 * s**2, 0.5 * t**2]
    return weights, slopes, [s, 3 * t - 2, 3 * s - 2, t]


class _Blend(torch.autograd.Function):
    """Features of all levels, blended for value and tangents, with the backward pass written out.

    Plain autograd goes through tensors of all taps of all points, one small operation for each
    step of the formulas, and sorts indices for each table.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        taps: Tensor,
        derivatives: tuple[Tensor, Tensor, Tensor],
        record: bool,
        *tables: Tensor,
    ) -> Tensor:
        """Blended features of points x (N, 2): (3, N, L · F).

        Args:
            taps: (L, k², N) rows of the tables that each point sees.
            derivatives: (L, 2, k, N) weights along either axis, and their first and second
                derivatives.
            record: whether there will be a backward pass.
            tables: one for each of L levels, (rows, F).
        """
        turned = record and ctx.needs_input_grad[0]
        count = derivatives[0].shape[-1]
        # value, ∂u, ∂v, and for the gradient by x: ∂uu, ∂uv, ∂vv
        orders = [(0, 0), (1, 0), (0, 1), *([(2, 0), (1, 1), (0, 2)] if turned else [])]
        blend = torch.stack(
            [derivatives[i][:, 0, :, None] * derivatives[j][:, 1, None] for i, j in orders], dim=1
        ).flatten(2, 3)
        rows = taps.transpose(1, 2)[:, None].expand(-1, len(orders), -1, -1)
        features = [
            nn.functional.embedding_bag(
                row.reshape(-1, row.shape[-1]),
                table,
                mode="sum",
                per_sample_weights=weight.transpose(1, 2).reshape(-1, weight.shape[1]),
            ).view(len(orders), count, table.shape[1])
            for row, weight, table in zip(rows, blend, tables, strict=True)
        ]
        out = torch.cat([f[:3] for f in features], dim=-1)
        trained = record and any(ctx.needs_input_grad[4:])
        ctx.save_for_backward(
            torch.cat([f[1:] for f in features], dim=-1) if turned else None,
            *((taps, blend[:, :3]) if trained else (None, None)),
        )
        ctx.shapes = [table.shape for table in tables]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        derivatives, taps, blend = ctx.saved_tensors
        by_x = None
        if derivatives is not None:
            u, v, uu, uv, vv = derivatives
            g, gu, gv = gradient
            by_x = torch.stack(
                [(g * u + gu * uu + gv * uv).sum(dim=1), (g * v + gu * uv + gv * vv).sum(dim=1)],
                dim=1,
            )
        by_table: list[Tensor | None] = [None] * len(ctx.shapes)
        if blend is not None:
            # points innermost: long rows for the processor
            g = gradient.transpose(1, 2).contiguous()
            g = g.view(3, len(ctx.shapes), 1, ctx.shapes[0][1], gradient.shape[1])
            shares = blend[:, 0, :, None] * g[0]
            for plane in (1, 2):
                shares.addcmul_(blend[:, plane, :, None], g[plane])
            width = shares.shape[2]
            places = taps[:, :, None] * width + torch.arange(width, device=taps.device)[:, None]
            for level, shape in enumerate(ctx.shapes):
                flat = gradient.new_zeros(shape).view(-1)
                flat.scatter_add_(0, places[level].flatten(), shares[level].flatten())
                by_table[level] = flat.view(shape)
        return (by_x, None, None, None, *by_table)


class SplineGrid(nn.Module):
    """Multi-resolution grids of trainable features, blended by uniform B-splines.

    Dense grids over [-extent, extent]², one per resolution, in the manner of multi-resolution
    hash encodings (Müller et al., SIGGRAPH 2022). The plane is small enough to need no hashing.
    B-splines in place of linear interpolation make the map C¹ (degree 2) or C² (degree 3), which
    the distortion energies of composed maps differentiate.

    Args:
        in_dim: 2, the only dimension that there is.
        resolutions: cells a side, one number per level.
        features: features per level; ``out_dim`` is ``2 + len(resolutions) * features``.
        degree: 2 or 3.
        extent: half the side of the square that the grid covers; x outside is clamped to it.

    Raises:
        ValueError: a parameter is out of range.
    """

    def __init__(
        self,
        in_dim: int = 2,
        resolutions: Sequence[int] = (8, 16, 32, 64, 128),
        features: int = 4,
        degree: int = 2,
        extent: float = 1.05,
    ) -> None:
        super().__init__()
        if in_dim != 2 or degree not in (2, 3):
            raise ValueError("encoding.degree must be 2 or 3, and encoding.in_dim 2")
        if not resolutions or min(resolutions) < 1:
            raise ValueError("encoding.resolutions needs one level or more, of 1 cell or more each")
        if features < 1 or extent <= 0:
            raise ValueError("encoding.features and encoding.extent must be positive")
        self.resolutions = [int(r) for r in resolutions]
        self.config = _config(
            self,
            in_dim,
            resolutions=self.resolutions,
            features=features,
            degree=degree,
            extent=float(extent),
        )
        self.degree, self.extent, self.features = degree, float(extent), features
        self.sides = [r + degree for r in self.resolutions]  # of the tables
        self.tables = nn.ParameterList(
            nn.Parameter(1e-2 * torch.randn(side**2, features)) for side in self.sides
        )
        self.out_dim = in_dim + features * len(self.resolutions)

    def _seen(
        self, x: Tensor, resolutions: Sequence[int] | None = None
    ) -> tuple[Tensor, list[list[Tensor]]]:
        """Of all levels, or those of some resolutions: rows (L, k², N) of the tables that points
        (N, 2) see, and the weights (L, 2, N) of the k rows along each axis, with their first and
        second derivatives by x."""
        size = torch.tensor(resolutions or self.resolutions, device=x.device)[:, None, None]
        per_unit = size.to(x.dtype) / (2 * self.extent)
        z = (x.t() + self.extent) * per_unit
        cell = z.detach().floor().clamp(min=0).minimum(size.to(x.dtype) - 1)
        free = z - cell
        offset = free.clamp(0, 1)
        within = (offset == free) * per_unit  # beyond the rim nothing changes
        weights, slopes, bends = _bspline(offset, self.degree)
        step = torch.arange(self.degree + 1, device=x.device)[:, None]
        corner = cell.long()
        across = (corner[:, 0, None] + step) * (size + self.degree)
        rows = across[:, :, None] + (corner[:, 1, None] + step)[:, None]
        scaled = [[w * within for w in slopes], [w * within * within for w in bends]]
        return rows.flatten(1, 2), [weights, *scaled]

    def seen(self, x: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """What points see of a level's table, which its features are linear in.

        Args:
            x: (N, 2).
            level: number of the resolution.

        Returns:
            rows (N, k²) of the table; their weights (3, N, k²) in value and both tangents.
        """
        rows, orders = self._seen(x, self.resolutions[level : level + 1])
        value, first, _ = (torch.stack(w, dim=2)[0] for w in orders)
        pairs = ((value, value), (first, value), (value, first))
        blend = torch.stack([(u[0, :, None] * v[1, None]).flatten(0, 1) for u, v in pairs])
        return rows[0].t(), blend.transpose(1, 2)

    def first_row(self, x: Tensor, level: int) -> Tensor:
        """The first row (N,) of a level's table that each of points (N, 2) sees."""
        return self._seen(x, self.resolutions[level : level + 1])[0][0, 0]

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        if transformed():
            return pushed_forward(self, Identity(2).value_and_jacobian_stack(x))
        with torch.no_grad():
            rows, orders = self._seen(x)
        return self._blended(x, rows, orders, list(self.tables))

    @classmethod
    def batched_stacks(cls, grids: Sequence[SplineGrid], x: Tensor) -> Tensor:
        """Values and both tangents of k grids of one configuration, each at points of its own.

        Args:
            x: (k, N, 2).

        Returns:
            (k, 3, N, out_dim).
        """
        first, points = grids[0], x.flatten(0, 1)
        with torch.no_grad():
            rows, orders = first._seen(points)
            lengths = [len(table) for table in first.tables]
            # the features of a level lie one grid below the other
            offsets = torch.tensor(lengths, device=x.device)[:, None] * torch.arange(
                len(grids), device=x.device
            )
            rows = rows + offsets.repeat_interleave(x.shape[1], dim=1)[:, None]
        tables = [torch.cat(level) for level in zip(*(g.tables for g in grids), strict=True)]
        stack = first._blended(points, rows, orders, tables)
        return stack.view(3, *x.shape[:2], -1).transpose(0, 1)

    @staticmethod
    def _blended(
        x: Tensor, rows: Tensor, orders: list[list[Tensor]], tables: list[Tensor]
    ) -> Tensor:
        value, first, second = (torch.stack(w, dim=2) for w in orders)
        unit = torch.eye(2, dtype=x.dtype, device=x.device)[:, None, :].expand(-1, x.shape[0], -1)
        blended = _Blend.apply(x, rows, (value, first, second), torch.is_grad_enabled(), *tables)
        return torch.cat([torch.cat([x[None], unit]), blended], dim=-1)

    def forward(self, x: Tensor) -> Tensor:
        rows, (weights, _, _) = self._seen(x)
        both = torch.stack(weights, dim=2)
        blend = (both[:, 0, :, None] * both[:, 1, None]).flatten(1, 2)
        parts = [x]
        for row, weight, table in zip(rows, blend, self.tables, strict=True):
            # not an embedding, whose backward pass sorts
            seen = table.index_select(0, row.flatten()).view(*row.shape, self.features)
            parts.append((weight[:, :, None] * seen).sum(dim=0))
        return torch.cat(parts, dim=-1)
