"""The curvature of a loss by what a planar map does at points, as far as it is positive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nsm.maps import SplineField


@dataclass(frozen=True)
class Curvature:
    """Second derivatives of a loss by h or J_h at points: it is about the sum over the points of
    ½ δᵀ H δ, besides its gradient.

    Attributes:
        map: h, around a :class:`nsm.maps.SplineField`.
        points: (N, 2) in Ω.
        hessians: H (N, 4, 4) by the entries of J_h, row by row; or (N, 2, 2) by h. Symmetric and
            positive semidefinite.
    """

    map: Any
    points: Tensor
    hessians: Tensor

    def of_field(self) -> tuple[SplineField, Tensor, Tensor]:
        """The same by what h's spline does, each of its components apart.

        Returns:
            The spline; the points (N, 2) at which h evaluates it; and (d, N, 3, 3) by the value
            and both derivatives of each of its d components: H seen through h's own Jacobian.
        """
        field = next(m for m in self.map.modules() if isinstance(m, SplineField))
        with torch.enable_grad():
            with field.watched() as evaluated:
                value, jacobian = self.map.value_and_jacobian(self.points)
            [(x, leaf)] = evaluated  # h evaluates its spline once
            wanted = value if self.hessians.shape[-1] == 2 else jacobian.flatten(1)
            rows = [
                torch.autograd.grad(entry.sum(), leaf, retain_graph=True)[0]
                for entry in wanted.unbind(dim=1)
            ]
        chain = torch.stack(rows).permute(3, 2, 0, 1)  # (entries, 3, N, d) to (d, N, entries, 3)
        return field, x, chain.mT @ self.hessians.to(chain) @ chain


def positive_hessians(function: Callable[[Tensor], Tensor], jacobian: Tensor) -> Tensor:
    """Second derivatives (N, 4, 4) of a function of Jacobians, without their negative eigenvalues.

    Args:
        function: from (N, 2, 2) to (N,), each entry by its own matrix alone.
        jacobian: (N, 2, 2); derivatives are by its entries, row by row.
    """
    with torch.enable_grad():
        at = jacobian.detach().double().requires_grad_()
        (gradient,) = torch.autograd.grad(function(at).sum(), at, create_graph=True)
        entries = gradient.flatten(1).unbind(dim=1)
        rows = [
            torch.autograd.grad(entry.sum(), at, retain_graph=True)[0].flatten(1)
            for entry in entries
        ]
    hessian = torch.stack(rows, dim=1).nan_to_num(0.0, 0.0, 0.0)
    values, vectors = torch.linalg.eigh(0.5 * (hessian + hessian.mT))
    return (vectors * values.clamp(min=0)[:, None, :]) @ vectors.mT
