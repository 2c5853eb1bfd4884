"""Squared distances of points to where they should be."""

from __future__ import annotations

from torch import Tensor

from nsm.energies.numerics import narrow, widen


def squared_distance(points: Tensor, targets: Tensor, what: str) -> Tensor:
    """‖p − q‖², (...), of points and targets (..., n).

    Args:
        what: the points are, in messages.

    Raises:
        ValueError: the shapes differ.
    """
    if points.shape != targets.shape:
        raise ValueError(
            f"{what} {tuple(points.shape)} and their targets {tuple(targets.shape)} differ"
        )
    return narrow(((widen(points) - widen(targets)) ** 2).sum(dim=-1), points.dtype)
