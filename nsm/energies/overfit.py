"""The two terms of Eq. 1 that fit a network to a surface: position and normal."""

from __future__ import annotations

import torch
from torch import Tensor

from nsm.energies.numerics import narrow, widen
from nsm.energies.squared_distance import squared_distance

# Under the root of ‖∂φ/∂u × ∂φ/∂v‖²: an area element under 1e-6 is a collapsed one, whose normal
# fades to zero; one of 1e-3 or more is altered by at most 5e-7 of itself.
NORMAL_FLOOR = 1e-12


def position(predicted: Tensor, target: Tensor) -> Tensor:
    """‖f(p) − φ(p)‖², the first term of Eq. 1.

    Args:
        predicted, target: (N, 3).

    Returns:
        (N,).

    Raises:
        ValueError: the shapes differ.
    """
    return squared_distance(predicted, target, "positions")


def normal(jacobian: Tensor, target_normal: Tensor) -> Tensor:
    """‖n_φ − n_f‖², the second term of Eq. 1, in [0, 4].

    n_φ is the normalised cross product of the Jacobian's columns; where that vanishes, n_φ fades
    to zero (the term is then 1) and the gradient stays finite.

    Args:
        jacobian: (N, 3, 2).
        target_normal: (N, 3), unit vectors.

    Returns:
        (N,).

    Raises:
        ValueError: the shapes are not these.
    """
    if jacobian.shape[-2:] != (3, 2) or jacobian.shape[:-1] != target_normal.shape:
        raise ValueError(
            f"a Jacobian {tuple(jacobian.shape)} is (N, 3, 2) with normals (N, 3), "
            f"not {tuple(target_normal.shape)}"
        )
    columns = widen(jacobian)
    cross = torch.linalg.cross(columns[..., 0], columns[..., 1], dim=-1)
    length = ((cross**2).sum(dim=-1, keepdim=True) + NORMAL_FLOOR).sqrt()
    return narrow(((cross / length - widen(target_normal)) ** 2).sum(dim=-1), jacobian.dtype)
