"""Maps h of a closed domain R²/Γ to itself, equivariant by construction.

The lattice is 2Z × 2Z; on the orbifold 2222, Γ has x ↦ -x too. h(γx) = γh(x) for all γ in Γ, so h
is continuous and of degree one; det J_h > 0 everywhere makes it a homeomorphism.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nsm.maps.planar import IdentityInitializedMap


class EquivariantMap(IdentityInitializedMap):
    """h(x) = x + (n(x) - n(-x)) / 2, a map of the orbifold 2222 to itself that keeps its cones.

    Args:
        network: n, with an encoding that has the period of the lattice, such as
            :class:`nsm.maps.LatticeSplineGrid`.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Points (..., N, 2) to points (..., N, 2), in the cover."""
        here, there = self.network(torch.cat([x, -x], dim=-2)).chunk(2, dim=-2)
        moved: Tensor = x + 0.5 * (here - there)
        return moved

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(..., N, 2) to the values (..., N, 2) and Jacobians (..., N, 2, 2)."""
        value, jacobian = self.network.value_and_jacobian(torch.cat([x, -x], dim=-2))
        here, there = value.chunk(2, dim=-2)
        by_here, by_there = jacobian.chunk(2, dim=-3)
        one = torch.eye(2, dtype=x.dtype, device=x.device)
        return x + 0.5 * (here - there), one + 0.5 * (by_here + by_there)


class TorusMap(IdentityInitializedMap):
    """h(x) = x + n(x), n periodic: a map of the flat torus to itself, in the identity's class.

    If n is odd, it is a map of the orbifold 2222 as well, which keeps its cones.

    Args:
        network: n, as for :class:`EquivariantMap`, or a :class:`nsm.maps.MultilevelSpline`.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Points (..., N, 2) to points (..., N, 2), in the cover."""
        moved: Tensor = x + self.network(x)
        return moved

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(..., N, 2) to the values (..., N, 2) and Jacobians (..., N, 2, 2)."""
        value, jacobian = self.network.value_and_jacobian(x)
        return x + value, torch.eye(2, dtype=x.dtype, device=x.device) + jacobian
