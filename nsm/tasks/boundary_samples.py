"""Points all along the boundary of Ω."""

from __future__ import annotations

import torch
from torch import Tensor

_COUNT = 512


def boundary_samples(domain: str) -> Tensor:
    """Points (N, 2) of ∂Ω, evenly spaced."""
    t = torch.arange(_COUNT) / _COUNT
    if domain == "disc":
        return torch.stack([torch.cos(2 * torch.pi * t), torch.sin(2 * torch.pi * t)], dim=1)
    side, along = (4 * t).long(), 2 * (4 * t).frac() - 1
    one = torch.ones_like(t)
    points = [(along, -one), (one, along), (-along, one), (-one, -along)]
    return torch.stack([torch.stack(p, dim=1) for p in points])[side, torch.arange(len(t))]
