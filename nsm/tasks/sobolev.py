"""Sobolev H¹ coordinates of a spline's coefficients: c = P y, P = (I + L)^(-1/2)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


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
