"""Sobolev H¹ coordinates of a spline's coefficients: c = P y, P = (I + L)^(-1/2)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from nsm.maps import SplineField
from nsm.tasks.multigrid import periodic_refinement_along, refinement_along


@lru_cache(maxsize=32)
def _axis(count: int, cells: int, periodic: bool) -> tuple[Tensor, Tensor]:
    """Orthonormal eigenvectors (count, count), one a column, and eigenvalues (count,) of minus the
    second difference along an axis, in units of Ω's half side.

    On a path, with free ends, they are those of the discrete cosine transform; on a cycle those
    of Hartley's, the Fourier transform in real numbers.
    """
    k = torch.arange(count, dtype=torch.float64)
    if periodic:
        angle = 2 * torch.pi / count * torch.outer(k, k)
        vectors, half_angle = (angle.cos() + angle.sin()) / count**0.5, torch.pi * k / count
    else:
        vectors = (torch.pi / count * torch.outer(k + 0.5, k)).cos() * (2 / count) ** 0.5
        vectors[:, 0] = count**-0.5
        half_angle = torch.pi * k / (2 * count)
    return vectors, (cells * half_angle.sin()) ** 2


class Sobolev:
    """P on coefficients (side², d) of a :class:`nsm.maps.SplineField`.

    I + L is the H¹ inner product ∫ c² + |∇c|² of functions on [-1, 1]², by differences of
    neighbouring coefficients, up to a factor.

    Args:
        side: coefficients along each axis.
        cells: of the grid along each axis.
        periodic: whether the last coefficient along an axis is beside the first.
        like: a tensor of the wanted type, on the wanted device.
    """

    def __init__(self, side: int, cells: int, periodic: bool, like: Tensor) -> None:
        vectors, values = _axis(side, cells, periodic)
        self.vectors = vectors.to(like)
        self.scale = (1 + values[:, None] + values).rsqrt().to(like)[..., None]

    def __call__(self, c: Tensor) -> Tensor:
        """P c, (side², d)."""
        q, side = self.vectors, len(self.vectors)
        grid = c.view(side, side, -1)
        spectrum = torch.einsum("ai,abd,bj->ijd", q, grid, q) * self.scale
        return torch.einsum("ai,ijd,bj->abd", q, spectrum, q).reshape(c.shape)


class Level:
    """The splines of n × n cells among those of a field's own grid.

    Args:
        field: its coefficients' number, type and device count.
        cells: n; the field has n times a power of two.

    Raises:
        ValueError: it has not.
    """

    def __init__(self, field: SplineField, cells: int) -> None:
        ups, finer = [], cells
        along = periodic_refinement_along if field.periodic else refinement_along
        while cells >= 3 and finer < field.cells:
            ups.append(along(finer))
            finer *= 2
        if finer != field.cells:
            raise ValueError(
                f"map.cells {field.cells} is not optimizer.levels' {cells}, 3 or more, times a "
                "power of two"
            )
        like = field.coefficients.detach()
        self.side = field.side - field.cells + cells
        self.sobolev = Sobolev(self.side, cells, field.periodic, like)
        self.up: Tensor | None = None
        for matrix in ups:
            up = torch.as_tensor(matrix.toarray())
            self.up = up if self.up is None else up @ self.up
        self.up = None if self.up is None else self.up.to(like)

    def prolonged(self, c: Tensor) -> Tensor:
        """The same spline's coefficients on the field's grid, (side², d) each."""
        if self.up is None:
            return c
        grid = c.view(self.side, self.side, -1)
        return torch.einsum("ai,ijd,bj->abd", self.up, grid, self.up).flatten(0, 1)

    def restricted(self, g: Tensor) -> Tensor:
        """The gradient by the level's coefficients, of that by the field's; the transpose."""
        if self.up is None:
            return g.clone()
        grid = g.view(len(self.up), len(self.up), -1)
        return torch.einsum("ai,abd,bj->ijd", self.up, grid, self.up).flatten(0, 1)
