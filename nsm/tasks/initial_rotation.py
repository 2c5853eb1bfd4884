"""Where the optimisation of a map starts: the rotation of the source's domain."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from nsm.energies import first_fundamental_form, rotation, symmetric_dirichlet

_ANGLES = 48


def landmark_rotation(domain: str, points: Tensor, targets: Tensor) -> Tensor:
    """The rotation (2, 2) that brings landmarks P (L, 2) nearest to Q (L, 2), keeping Ω.

    On the square it is the nearest multiple of 90\u00b0: others do not keep the square.
    """
    turn = rotation(points, targets)
    if domain == "disc":
        return turn
    angle = float(torch.atan2(turn[1, 0], turn[0, 0]))
    return _rotation(round(angle / (math.pi / 2)) * math.pi / 2).to(turn)


def least_distorting_rotation(domain: str, phi: nn.Module, psi: nn.Module, uv: Tensor) -> Tensor:
    """Without landmarks: the rotation R (2, 2) with the least median symmetric Dirichlet of ψ∘R.

    Args:
        domain: ``disc`` (tried every few degrees) or ``square`` (four rotations).
        phi, psi: source and target.
        uv: (N, 2) points of Ω, where it is measured.
    """
    count = _ANGLES if domain == "disc" else 4
    turns = [_rotation(2 * math.pi * k / count).to(uv) for k in range(count)]
    with torch.no_grad():
        source = first_fundamental_form(phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        values = []
        for turn in turns:
            _, jacobian = psi.value_and_jacobian(uv @ turn.T)  # type: ignore[operator]
            energy = symmetric_dirichlet(source, first_fundamental_form(jacobian @ turn))
            values.append(float(energy.median()))
    return turns[min(range(count), key=values.__getitem__)]


def _rotation(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s], [s, c]])
