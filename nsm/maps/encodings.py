"""Encodings of the plane: what a network sees instead of the bare (u, v)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn


class Identity(nn.Module):
    """No encoding: the coordinates themselves."""

    def __init__(self, in_dim: int) -> None:
        super().__init__()
        self.out_dim = in_dim

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
        sigma: standard deviation of B's entries, in cycles per unit of the domain.
    """

    def __init__(self, in_dim: int, features: int = 64, sigma: float = 2.0) -> None:
        super().__init__()
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


def _bspline(t: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Weights (N, degree + 1) of the uniform B-spline at offset t in [0, 1), and d/dt."""
    if degree == 2:
        s = 1 - t
        weights = torch.stack([0.5 * s * s, 0.5 + t * s, 0.5 * t * t], dim=-1)
        slopes = torch.stack([-s, 1 - 2 * t, t], dim=-1)
    else:
        s = 1 - t
        weights = torch.stack(
            [
                s**3 / 6,
                (3 * t**3 - 6 * t**2 + 4) / 6,
                (3 * s**3 - 6 * s**2 + 4) / 6,
                t**3 / 6,
            ],
            dim=-1,
        )
        slopes = torch.stack(
            [-0.5 * s**2, 1.5 * t**2 - 2 * t, 2 * s - 1.5 * s**2, 0.5 * t**2], dim=-1
        )
    return weights, slopes


class SplineGrid(nn.Module):
    """Multi-resolution grids of trainable features, blended by uniform B-splines.

    Dense grids over [-extent, extent]², one per resolution, in the manner of multi-resolution
    hash encodings (Müller et al., SIGGRAPH 2022); the plane is small enough that no hashing is
    needed, and B-splines in place of linear interpolation make the map C¹ (degree 2) or C²
    (degree 3), which the distortion energies of composed maps differentiate.

    Args:
        in_dim: 2; grids of other dimension are not offered.
        resolutions: cells a side, one number per level.
        features: features per level; ``out_dim`` is ``2 + len(resolutions) * features``.
        degree: 2 or 3.
        extent: half the side of the square that is covered; x outside is clamped to its rim.
    """

    def __init__(
        self,
        in_dim: int,
        resolutions: Sequence[int] = (8, 16, 32, 64, 128),
        features: int = 4,
        degree: int = 2,
        extent: float = 1.05,
    ) -> None:
        super().__init__()
        if in_dim != 2 or degree not in (2, 3):
            raise ValueError("the spline grid takes points of the plane and degree 2 or 3")
        self.resolutions = [int(r) for r in resolutions]
        self.degree, self.extent, self.features = degree, float(extent), features
        self.tables = nn.ParameterList(
            nn.Parameter(1e-2 * torch.randn((r + degree) ** 2, features)) for r in self.resolutions
        )
        self.out_dim = in_dim + features * len(self.resolutions)

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        k = self.degree + 1
        taps = torch.arange(k, device=x.device)
        unit = torch.eye(2, dtype=x.dtype, device=x.device)[:, None, :].expand(-1, x.shape[0], -1)
        parts = [torch.cat([x[None], unit])]
        for resolution, table in zip(self.resolutions, self.tables, strict=True):
            per_unit = resolution / (2 * self.extent)
            z = (x + self.extent) * per_unit
            cell = z.detach().floor().clamp(0, resolution - 1)
            weights, slopes = _bspline((z - cell).clamp(0, 1), self.degree)
            slopes = slopes * per_unit
            index = cell.long()[:, :, None] + taps
            flat = index[:, 0, :, None] * (resolution + self.degree) + index[:, 1, None, :]
            gathered = nn.functional.embedding(flat.reshape(len(x), k * k), table)
            blend = torch.stack(
                [
                    weights[:, 0, :, None] * weights[:, 1, None, :],
                    slopes[:, 0, :, None] * weights[:, 1, None, :],
                    weights[:, 0, :, None] * slopes[:, 1, None, :],
                ],
                dim=1,
            ).reshape(len(x), 3, k * k)
            parts.append(torch.bmm(blend, gathered).transpose(0, 1))
        return torch.cat(parts, dim=-1)

    def forward(self, x: Tensor) -> Tensor:
        return self.value_and_jacobian_stack(x)[0]


Encoding = Identity | RandomFourierFeatures | SplineGrid

ENCODINGS: dict[str, type[Encoding]] = {
    "identity": Identity,
    "fourier": RandomFourierFeatures,
    "spline_grid": SplineGrid,
}
