"""Planar maps the other way round: h⁻¹, found by Newton's method."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from nsm.maps.composition import PointMap

_STEPS, _HALVINGS, _SHRINK = 30, 12, 0.5
_EXACT = 1e-13
_STARTS, _ENOUGH = 12, 1e-9


@torch.no_grad()
def inverted(h: nn.Module, targets: Tensor, start: Tensor, onto: str | None = None) -> Tensor:
    """Points x (N, 2) with h(x) = targets (N, 2), by damped Newton steps from start (N, 2).

    A step that would not come nearer is halved; where none helps, the point stays as it is, so
    that the result is never farther off than the start.

    Args:
        h: a planar map with ``value_and_jacobian``, injective near the points.
        targets, start: (N, 2); float64 for the last digits, where h is of that type.
        onto: ``disc`` or ``square``, which no x may leave: outside, h is whatever its network
            makes of it.
    """
    x = start.clone()
    moving = torch.arange(len(x), device=x.device)
    for _ in range(_STEPS):
        value, jacobian = cast(PointMap, h).value_and_jacobian(x[moving])
        off = targets[moving] - value
        distance = off.norm(dim=1)
        safe = torch.linalg.det(jacobian).abs() > 1e-12
        identity = torch.eye(2, dtype=x.dtype, device=x.device)
        step = torch.linalg.solve(torch.where(safe[:, None, None], jacobian, identity), off)
        left = (distance >= _EXACT).nonzero()[:, 0]
        moved = torch.zeros_like(safe)
        for _ in range(_HALVINGS):
            if len(left) == 0:
                break
            index = moving[left]
            trial = _kept(x[index] + step[left], onto)
            now = (targets[index] - h(trial)).norm(dim=1) < distance[left]
            x[index[now]] = trial[now]
            moved[left[now]] = True
            left = left[~now]
            step[left] *= _SHRINK
        moving = moving[moved]  # one that no step helps would only try the same again
        if len(moving) == 0:
            break
    return x


def _kept(x: Tensor, onto: str | None) -> Tensor:
    if onto == "disc":
        return x / torch.linalg.vector_norm(x, dim=1, keepdim=True).clamp(min=1)
    return x.clamp(-1, 1) if onto == "square" else x


class TransitionMap(nn.Module):
    """h_j∘h_i⁻¹: from the domain of one surface of a collection to that of another.

    Args:
        first, second: h_i and h_j, from the common domain.
        nodes: (M, 2) points of the common domain; Newton's method starts from the few whose
            images under h_i are nearest, until one leads to the point.
        onto: the domain that h_i keeps to, if any.
    """

    nodes: Tensor

    def __init__(
        self, first: nn.Module, second: nn.Module, nodes: Tensor, onto: str | None = None
    ) -> None:
        super().__init__()
        self.first, self.second, self.onto = first, second, onto
        self.register_buffer("nodes", nodes, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return self.second(self.back(x))

    @torch.no_grad()
    def back(self, x: Tensor) -> Tensor:
        """h_i⁻¹: (N, 2) to points (N, 2) of the common domain."""
        images = self.first(self.nodes)
        near = torch.cat(
            [
                torch.cdist(part, images).topk(min(_STARTS, len(images)), largest=False).indices
                for part in x.split(2048)
            ]
        )
        result = inverted(self.first, x, self.nodes[near[:, 0]], self.onto)
        off = (self.first(result) - x).norm(dim=1)
        for k in range(1, near.shape[1]):
            missed = (off > _ENOUGH).nonzero()[:, 0]
            if len(missed) == 0:
                break
            other = inverted(self.first, x[missed], self.nodes[near[missed, k]], self.onto)
            distance = (self.first(other) - x[missed]).norm(dim=1)
            better = distance < off[missed]
            result[missed[better]], off[missed[better]] = other[better], distance[better]
        return result
