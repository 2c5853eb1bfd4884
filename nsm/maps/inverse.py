"""Inverses h⁻¹ of planar maps, by Newton's method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from nsm.maps.composition import PointMap

_STEPS, _HALVINGS, _SHRINK = 30, 12, 0.5
# share of the distance by which a step comes nearer at least: less is rounding, again and again
_NEARER = 1e-3
_EXACT = 1e-13
_STARTS = 12
_ENOUGH = 1e-7  # digits of single precision, which constants of h have


@torch.no_grad()
def inverted(
    h: nn.Module,
    targets: Tensor,
    start: Tensor,
    project: Callable[[Tensor], Tensor] | None = None,
) -> Tensor:
    """Points x (N, 2) with h(x) = targets (N, 2), by damped Newton steps from start (N, 2).

    A step that does not come nearer is halved; where none does, the point stays, so that the
    result is never farther off than the start.

    Args:
        h: a planar map with ``value_and_jacobian``, injective near the points.
        targets, start: (N, 2); float64 for the last digits, where h is of that type.
        project: from points (N, 2) to the nearest ones of Ω, which no x may leave; outside, h
            extrapolates.
    """
    x = start.clone()
    moving = torch.arange(len(x), device=x.device)
    evaluated = cast(PointMap, h).value_and_jacobian
    value, jacobian = (part.clone() for part in evaluated(x))
    for _ in range(_STEPS):
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
            trial = x[index] + step[left]
            if project is not None:
                trial = project(trial)
            # most steps are taken: the Jacobian is for the next one
            there, slope = evaluated(trial)
            now = (targets[index] - there).norm(dim=1) < (1 - _NEARER) * distance[left]
            x[index[now]] = trial[now]
            value[left[now]], jacobian[left[now]] = there[now], slope[now]
            moved[left[now]] = True
            left = left[~now]
            step[left] *= _SHRINK
        # the others would only try the same steps again
        moving, value, jacobian = (part[moved] for part in (moving, value, jacobian))
        if len(moving) == 0:
            break
    return x


class Inverse:
    """h⁻¹ of a planar map that does not change.

    Args:
        h: as for :func:`inverted`.
        nodes: (M, 2); Newton's method starts from the few whose images under h are nearest to a
            target, until one leads to it.
        project: where h maps Ω onto itself, from points (N, 2) to the nearest ones of Ω, for which
            targets outside, by rounding, stand.
    """

    @torch.no_grad()
    def __init__(
        self,
        h: nn.Module,
        nodes: Tensor,
        project: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        self.h, self.nodes, self.project = h, nodes, project
        self._images = cKDTree(h(nodes).cpu().numpy())

    @torch.no_grad()
    def __call__(self, targets: Tensor) -> Tensor:
        """Points x (N, 2) with h(x) = targets (N, 2), wherever they lie."""
        h, project = self.h, self.project
        if project is not None:
            targets = project(targets)
        result = inverted(h, targets, self._start(targets, 1), project)
        off = (h(result) - targets).norm(dim=1)
        for k in range(2, min(_STARTS, len(self.nodes)) + 1):
            missed = (off > _ENOUGH).nonzero()[:, 0]
            if len(missed) == 0:
                break
            other = inverted(h, targets[missed], self._start(targets[missed], k), project)
            distance = (h(other) - targets[missed]).norm(dim=1)
            better = distance < off[missed]
            result[missed[better]], off[missed[better]] = other[better], distance[better]
        return result

    def _start(self, targets: Tensor, k: int) -> Tensor:
        """The nodes with the k-th nearest images."""
        near = self._images.query(targets.cpu().numpy(), k=[k])[1][:, 0]
        return self.nodes[torch.as_tensor(near, device=self.nodes.device)]


class _Inverse(torch.autograd.Function):
    """x ↦ h_i⁻¹(x) of a :class:`TransitionMap`, differentiated by the inverse function theorem."""

    @staticmethod
    def forward(x: Tensor, transition: TransitionMap) -> Tensor:
        return transition.back(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, TransitionMap], output: Tensor) -> None:
        ctx.transition = inputs[1]
        ctx.save_for_backward(output)
        ctx.save_for_forward(output)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        jacobian = ctx.transition.first.value_and_jacobian(ctx.saved_tensors[0])[1]
        return torch.linalg.solve(jacobian.mT, gradients[0]), None

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor) -> Tensor:
        jacobian = ctx.transition.first.value_and_jacobian(ctx.saved_tensors[0])[1]
        return torch.linalg.solve(jacobian, tangents[0])

    @staticmethod
    def vmap(info: Any, in_dims: Any, x: Tensor, transition: TransitionMap) -> tuple[Tensor, int]:
        points = x.movedim(in_dims[0], 0)
        flat: Tensor = _Inverse.apply(points.reshape(-1, 2), transition)
        return flat.view(points.shape), 0


class TransitionMap(nn.Module):
    """h_j∘h_i⁻¹: from the domain of one surface of a collection to that of another.

    Args:
        first, second: h_i and h_j, from the common domain.
        nodes: (M, 2) points of the common domain (see :class:`Inverse`).
        project: from points (N, 2) to the nearest ones of the common domain, if h_i keeps to it.
    """

    nodes: Tensor

    def __init__(
        self,
        first: nn.Module,
        second: nn.Module,
        nodes: Tensor,
        project: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.first, self.second, self.project = first, second, project
        self.register_buffer("nodes", nodes, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return self.second(self._preimage(x))

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians J_j·J_i⁻¹ (N, 2, 2)."""
        y = self._preimage(x)
        inner = cast(PointMap, self.first).value_and_jacobian(y)[1]
        value, outer = cast(PointMap, self.second).value_and_jacobian(y)
        return value, torch.linalg.solve(inner, outer, left=False)

    def _preimage(self, x: Tensor) -> Tensor:
        """h_i⁻¹(x) (N, 2), with derivatives by the inverse function theorem."""
        y: Tensor = _Inverse.apply(x, self)
        if torch.is_grad_enabled() and any(p.requires_grad for p in self.first.parameters()):
            # where the weights of h_i move, h_i(y) = x stays true for dy = -J_i⁻¹ dh_i
            value, jacobian = cast(PointMap, self.first).value_and_jacobian(y.detach())
            change = (value - value.detach())[..., None]
            y = y - torch.linalg.solve(jacobian.detach(), change)[..., 0]
        return y

    def back(self, x: Tensor) -> Tensor:
        """h_i⁻¹: (N, 2) to points (N, 2) of the common domain."""
        return Inverse(self.first, self.nodes, self.project)(x)
