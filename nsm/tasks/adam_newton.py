"""Adam first, quasi-Newton steps at the end: what maps are trained by."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch

from nsm.maps import SplineField
from nsm.settings import Share
from nsm.tasks.multilevel_adam import MultilevelAdam
from nsm.tasks.quasi_newton import QuasiNewton


class AdamThenNewton(QuasiNewton):
    """Steps of Adam in the coordinates of a spline's levels, then quasi-Newton steps.

    Adam's samples, other ones in each step, lead past the local minima of a fixed quadrature. Near
    the end its noise is what is left, and few quasi-Newton steps, at the mesh's own triangles,
    reach what Adam needs a thousand steps for.

    Args:
        params: the coefficients of all ``fields``.
        fields: the splines.
        max_steps: length of the training.
        newton_from: share of the steps after which they are quasi-Newton's.
        iterations: of L-BFGS in a quasi-Newton step.
        memory: pairs of steps and changes of the gradient that are kept.
        smoothing: weight of the smoothness in quasi-Newton steps.
        lr: Adam's rate, of a level's coordinates.
        betas, eps: Adam's.
        clip: largest norm of a gradient that Adam takes, by the levels' coordinates.

    Raises:
        ValueError: a parameter is out of range.
    """

    def __init__(
        self,
        params: Iterable[Any],
        fields: Sequence[SplineField],
        max_steps: int,
        newton_from: Share = 0.97,
        iterations: int = 25,
        memory: int = 30,
        smoothing: float = 0.1,
        lr: float = 1e-2,
        betas: Sequence[float] = (0.9, 0.99),
        eps: float = 1e-12,
        clip: float = 1.0,
    ) -> None:
        cells = [field.cells for field in fields]
        super().__init__(params, fields, cells[:1], [], iterations, memory, smoothing, lr)
        self.newton_from = newton_from * max_steps
        self.adams = [
            MultilevelAdam(f, (float(betas[0]), float(betas[1])), eps, clip) for f in fields
        ]

    @property
    def first_length(self) -> float:
        return 1.0  # the rate is Adam's

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """A step of Adam, or the iterations of a quasi-Newton step.

        Args:
            closure: evaluates loss and gradients at the present coefficients.

        Returns:
            The loss; after a quasi-Newton step, that at its end.
        """
        count = self.state[self.fields[0].coefficients]
        if count["step"] >= self.newton_from:
            return super().step(closure)
        assert closure is not None
        with torch.enable_grad():
            loss = closure()
        if loss is None or any(f.coefficients.grad is None for f in self.fields):  # rolled back
            return None
        for adam, fields in self._batches():
            changes = adam.changes(
                [field.coefficients.grad for field in fields],  # type: ignore[misc]
                [self.state[field.coefficients] for field in fields],
                count["step"],
                self.param_groups[0]["lr"],
            )
            for field, change in zip(fields, changes, strict=True):
                field.coefficients.add_(change)
        count["step"] += 1
        return loss

    def _batches(self) -> list[tuple[MultilevelAdam, list[SplineField]]]:
        """The fields that take a step together: on a device, where each operation has its own cost,
        all that are alike."""
        alike = len({field.grids + (field.out_dim,) for field in self.fields}) == 1
        if alike and self.fields[0].coefficients.device.type != "cpu":
            return [(self.adams[0], self.fields)]
        return [(adam, [field]) for adam, field in zip(self.adams, self.fields, strict=True)]
