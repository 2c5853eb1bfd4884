"""Where the optimisation of a map starts: a rotation of the source's domain, or, on a closed
domain, an affine map of the lattice."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor, nn

from nsm.domains import Domain
from nsm.domains import domain as domain_of
from nsm.domains.orbifold.alignment import Alignment
from nsm.energies import first_fundamental_form, rotation, symmetric_dirichlet
from nsm.maps import LatticeAligned, Rotated


def aligned(found: Alignment) -> LatticeAligned:
    """The start x ↦ Bx + c of an alignment, around the identity."""
    matrix, shift = (torch.as_tensor(x, dtype=torch.float32) for x in (found.matrix, found.shift))
    return LatticeAligned(nn.Identity(), matrix, shift)


def carried(
    points: np.ndarray,
    through: Rotated | LatticeAligned,
    back_by: Rotated | LatticeAligned | None = None,
) -> np.ndarray:
    """Points (N, 2) by a start, after the inverse of another one: what a map is before it is
    trained."""
    x = torch.as_tensor(points, dtype=torch.float64)
    if back_by is not None:
        x = copy.deepcopy(back_by).double().back(x)
    return copy.deepcopy(through).double().before(x).numpy()


def landmark_rotation(domain: str | Domain, points: Tensor, targets: Tensor) -> Tensor:
    """The rotation (2, 2) that brings landmarks P (L, 2) nearest to Q (L, 2), keeping Ω."""
    return domain_of(domain).nearest_rotation(rotation(points, targets))


def least_distorting_rotation(
    domain: str | Domain, phi: nn.Module, psi: nn.Module, uv: Tensor
) -> Tensor:
    """Without landmarks: the rotation R (2, 2) with the least median symmetric Dirichlet of ψ∘R.

    Args:
        domain: Ω; its :meth:`~nsm.domains.Domain.rotations` are tried.
        phi, psi: source and target.
        uv: (N, 2) points of Ω, where it is measured.
    """
    candidates = torch.as_tensor(domain_of(domain).rotations()).to(uv)
    values = []
    with torch.no_grad():
        source = first_fundamental_form(phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        for turn in candidates:
            _, jacobian = psi.value_and_jacobian(uv @ turn.T)  # type: ignore[operator]
            energy = symmetric_dirichlet(source, first_fundamental_form(jacobian @ turn))
            values.append(float(energy.median()))
    return candidates[min(range(len(values)), key=values.__getitem__)]
