"""Adam in the coordinates of a spline's levels: a step of a coarse one moves all around it."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsm.maps import SplineField
from nsm.tasks.spline_level import Level

_LEAST = 4  # cells
# A coefficient is its coordinate times this over √cells: a step of a fine level then does not
# change slopes much more than that of a coarse one.
_SCALE = 0.5


class MultilevelAdam:
    """Adam (Kingma and Ba, 2015) on y, where a spline's coefficients are Σ s_l P_l y_l.

    P_l refines the level l, of half the cells of the next, to the spline's own grid (two-scale
    relation), so that y are coordinates like those of the Sobolev space H¹ (Bramble, Pasciak and
    Xu, 1990). Coefficients are a sum of the levels', so only the moments of y are kept.

    Args:
        field: the spline.
        betas: of the moments.
        eps: beside the root of the second moment.
        largest: norm of the gradient by y; longer ones are shortened.
    """

    def __init__(
        self, field: SplineField, betas: tuple[float, float], eps: float, largest: float
    ) -> None:
        self.betas, self.eps, self.largest = betas, eps, largest
        cells = [field.cells]
        while cells[0] % 2 == 0 and cells[0] // 2 >= _LEAST and not (field.odd and cells[0] % 4):
            cells.insert(0, cells[0] // 2)
        self.scales = [_SCALE / n**0.5 for n in cells]
        self.refinements = [
            _on(Level(SplineField(1, 2 * n, field.periodic, field.odd), n).up, field.coefficients)
            for n in cells[:-1]
        ]
        self.turned = [up.t().coalesce() for up in self.refinements]

    def change(
        self, gradient: Tensor, state: MutableMapping[str, Any], step: int, lr: float
    ) -> Tensor:
        """What a step adds to the coefficients, and the moments after it in the state.

        Args:
            gradient: (rows, d) by the coefficients.
            state: of the optimizer; the moments of each level are ``moments_NUMBER`` (2, rows, d).
            step: from 0.
            lr: the rate.
        """
        of_levels = [gradient]
        for down in reversed(self.turned):
            of_levels.insert(0, down @ of_levels[0])
        of_levels = [scale * g for scale, g in zip(self.scales, of_levels, strict=True)]
        # one bad sample would be remembered in the moments for long
        norm = torch.stack([g.norm() for g in of_levels]).norm()
        clip = (self.largest / norm.clamp(min=1e-30)).clamp(max=1.0)
        total: Tensor | None = None
        for number, (g, scale) in enumerate(zip(of_levels, self.scales, strict=True)):
            first, second = self._moments(state, number, g)
            first.lerp_(clip * g, 1 - self.betas[0])
            second.lerp_((clip * g).square(), 1 - self.betas[1])
            unbiased = [1 - beta ** (step + 1) for beta in self.betas]
            root = (second / unbiased[1]).sqrt_().add_(self.eps)
            own = first / root * (-lr * scale / unbiased[0])
            total = own if total is None else self.refinements[number - 1] @ total + own
        assert total is not None
        return total

    def _moments(self, state: MutableMapping[str, Any], number: int, g: Tensor) -> Tensor:
        key = f"moments_{number}"
        if key not in state:
            state[key] = torch.zeros(2, *g.shape, dtype=g.dtype, device=g.device)
        moments: Tensor = state[key]
        return moments


def _on(matrix: Any, like: Tensor) -> Tensor:
    """A sparse matrix of the type and on the device of a tensor."""
    m = matrix.tocoo()
    places = torch.from_numpy(np.stack([m.row, m.col]).astype(np.int64))
    values = torch.from_numpy(m.data.astype(np.float64)).to(like.dtype)
    return (
        torch.sparse_coo_tensor(places, values, m.shape, check_invariants=False)
        .coalesce()
        .to(like.device)
    )
