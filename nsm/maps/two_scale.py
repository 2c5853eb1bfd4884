"""The two-scale relation of uniform B-splines, and the levels of a spline that it joins.

A spline is one on a grid of twice as many cells too. So splines on grids from coarse to fine add up
to one on the finest (Bramble, Pasciak and Xu, 1990).
"""

from __future__ import annotations

from math import comb

import torch
from torch import Tensor

_LEAST = 4  # cells
# A coefficient is its coordinate times this over √cells: the rate of feature grids behind a network
# then suits, and a step of a fine level does not change slopes much more than that of a coarse one.
_SCALE = 0.5


def two_scale_weights(degree: int) -> list[float]:
    """The coefficients (degree + 2) by which a B-spline is a sum of those on half as long cells."""
    return [comb(degree + 1, k) / 2**degree for k in range(degree + 2)]


FAR, NEAR = two_scale_weights(2)[:2]  # 1/4, 3/4


def refined(c: Tensor, axis: int, wide: Tensor | None = None) -> Tensor:
    """Coefficients of the same quadratic spline for cells half as long along an axis.

    Args:
        c: (..., n, ...) along the axis.
        axis: not negative.
        wide: (..., n + 2, ...), c with what is next beyond its first and last; by default c is
            periodic.

    Returns:
        (..., 2n, ...): two in place of each, towards its neighbours.
    """
    near, count = NEAR * c, c.shape[axis]
    first = near + FAR * (c.roll(1, axis) if wide is None else wide.narrow(axis, 0, count))
    second = near + FAR * (c.roll(-1, axis) if wide is None else wide.narrow(axis, 2, count))
    return torch.stack([first, second], dim=axis + 1).flatten(axis, axis + 1)


def level_cells(cells: int, even: bool = False) -> list[int]:
    """Cells along an axis of all levels, each twice as many as the one before, up to ``cells``.

    Args:
        cells: of the finest.
        even: no level has an odd number.
    """
    found = [cells]
    while found[0] % 2 == 0 and found[0] // 2 >= _LEAST and not (even and found[0] % 4):
        found.insert(0, found[0] // 2)
    return found


def level_scale(cells: int) -> float:
    """A coefficient of a level of so many cells over the coordinate that is trained."""
    return float(_SCALE / cells**0.5)
