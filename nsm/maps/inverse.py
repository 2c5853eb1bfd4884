"""Planar maps the other way round: h⁻¹, found by Newton's method."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from nsm.maps.composition import PointMap

_STEPS = 25
_SHRINK = 0.5


@torch.no_grad()
def inverted(h: nn.Module, targets: Tensor, start: Tensor) -> Tensor:
    """Points x (N, 2) with h(x) = targets (N, 2), by damped Newton steps from start (N, 2).

    A step that would not come nearer is halved; where none helps, the point stays as it is, so
    that the result is never farther off than the start. Inside is kept to by the caller's choice
    of h: outside Ω a map is whatever its network makes of it.

    Args:
        h: a planar map with ``value_and_jacobian``, injective near the points.
        targets, start: (N, 2); float64 for the last digits, where h is of that type.
    """
    x = start.clone()
    for _ in range(_STEPS):
        value, jacobian = cast(PointMap, h).value_and_jacobian(x)
        off = targets - value
        distance = off.norm(dim=1)
        safe = torch.linalg.det(jacobian).abs() > 1e-12
        identity = torch.eye(2, dtype=x.dtype, device=x.device)
        step = torch.linalg.solve(torch.where(safe[:, None, None], jacobian, identity), off)
        scale = torch.ones_like(distance)
        for _ in range(6):
            nearer = (targets - h(x + scale[:, None] * step)).norm(dim=1) < distance
            scale = torch.where(nearer, scale, scale * _SHRINK)
        x = torch.where(nearer[:, None], x + scale[:, None] * step, x)
        if float(distance.max()) < 1e-12 or not nearer.any():
            break
    return x


class Between(nn.Module):
    """h_j∘h_i⁻¹: from the domain of one surface of a collection to that of another.

    Args:
        first, second: h_i and h_j, from the common domain.
        nodes: (M, 2) points of the common domain; Newton's method starts from the one whose image
            under h_i is nearest.
    """

    def __init__(self, first: nn.Module, second: nn.Module, nodes: Tensor) -> None:
        super().__init__()
        self.first, self.second = first, second
        self.register_buffer("nodes", nodes, persistent=False)

    nodes: Tensor

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return self.second(self.back(x))

    def back(self, x: Tensor) -> Tensor:
        """h_i⁻¹: (N, 2) to points (N, 2) of the common domain."""
        images = self.first(self.nodes)
        nearest = torch.cat([torch.cdist(part, images).argmin(dim=1) for part in x.split(2048)])
        return inverted(self.first, x, self.nodes[nearest])
