"""L-BFGS in Sobolev coordinates on the coefficients of splines, coarse levels first (METHOD)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from nsm.maps import SplineField
from nsm.tasks.sobolev import Level

_SUFFICIENT = 1e-4  # Armijo: share of the decrease that the slope promises
_TRIALS = 12
_Found = tuple[Any, Tensor, float]  # loss, gradient on the level, and least det J_h
_FLAT = 1e-10  # curvature relative to the lengths of step and change under which it is noise


class QuasiNewton(Optimizer):
    """Each step makes several iterations of L-BFGS on one batch, whose loss must stay the same.

    On a level of n cells h's displacement is restricted to the splines of n × n cells, which are
    among those of the field's own, finer grid (the two-scale relation): a finer level starts with
    the same function. L-BFGS starts from P Pᵀ there, P the H¹ coordinates of
    :class:`nsm.tasks.sobolev.Sobolev`. The line search goes back until the loss has decreased as
    Armijo asks and the least det J_h at the samples, if it is known, is positive or has grown.

    Args:
        params: the coefficients of the fields, and nothing else.
        fields: the splines.
        levels: cells along each axis of each level; each field's own number of cells is a level's
            times a power of two.
        steps: of each level but the last, which lasts until the end. Fields that are not zero, as
            in a further training, have the last level alone.
        iterations: of L-BFGS in a step.
        memory: pairs of steps and changes of the gradient that are kept.
        first_step: largest change of a coefficient in the first iteration of a level, in Ω's half
            side.
        lr: the length that the line search tries first, in quasi-Newton steps.

    Raises:
        ValueError: a parameter is out of range, or a level does not fit a field.
    """

    def __init__(
        self,
        params: Iterable[Any],
        fields: Sequence[SplineField],
        levels: Sequence[int] = (8, 16, 32, 64, 128),
        steps: Sequence[int] = (2, 2, 2, 3),
        iterations: int = 20,
        memory: int = 12,
        first_step: float = 0.02,
        lr: float = 1.0,
    ) -> None:
        if len(steps) != len(levels) - 1 or min(steps, default=0) < 0:
            raise ValueError("optimizer.steps has one number, 0 or more, per level but the last")
        if min(iterations, memory) < 1 or not (first_step > 0 and lr > 0):
            raise ValueError(
                "optimizer.iterations, memory, first_step and lr must be above 0"
            )
        super().__init__(params, {"lr": lr})
        held = [p for group in self.param_groups for p in group["params"]]
        if {id(p) for p in held} != {id(f.coefficients) for f in fields}:
            raise ValueError("optimizer=quasi_newton trains splines alone; take map=spline with it")
        self.fields, self.levels, self.counts = list(fields), list(levels), list(steps)
        for field in fields:
            for cells in levels:
                Level(field, cells)  # ValueError for one that does not fit
        self.iterations, self.memory, self.first_step = iterations, memory, first_step
        self.least: Callable[[], Tensor | None] = lambda: None
        fresh = not any(f.coefficients.detach().count_nonzero() for f in fields)
        state = self.state[self.fields[0].coefficients]
        state["step"], state["s"], state["y"] = 0 if fresh else sum(steps), [], []
        self._level: tuple[int, list[Level]] | None = None

    def watch(self, least: Callable[[], Tensor | None]) -> None:
        """Take the function that gives the least det J_h of the last evaluation."""
        self.least = least

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """The iterations of a step.

        Args:
            closure: evaluates loss and gradients at the present coefficients.

        Returns:
            The loss after the step.
        """
        assert closure is not None, "L-BFGS evaluates the loss more than once in a step"
        state = self.state[self.fields[0].coefficients]
        number = sum(state["step"] >= end for end in _ends(self.counts))
        if self._level is None or self._level[0] != number:
            self._level = number, [Level(f, self.levels[number]) for f in self.fields]
        if state["step"] in _ends(self.counts):
            state["s"], state["y"] = [], []  # of the level before
        state["step"] += 1
        found = self._evaluated(closure)
        for _ in range(self.iterations):
            if found is None:  # rolled back from a loss that is not finite
                return None
            moved = self._searched(closure, state, found)
            if moved is found:  # no step along that direction serves
                if not state["s"]:
                    break
                state["s"], state["y"] = [], []
            found = moved
        return None if found is None else found[0]

    def _evaluated(self, closure: Callable[[], Any]) -> _Found | None:
        """Loss, gradient on the level, and least det J_h; None if the step was rolled back."""
        assert self._level is not None
        with torch.enable_grad():
            loss = closure()
        least = self.least()
        gradients = [f.coefficients.grad for f in self.fields]
        if loss is None or any(g is None for g in gradients):
            return None
        parts = [
            level.restricted(g).flatten()
            for level, g in zip(self._level[1], gradients, strict=True)
            if g is not None
        ]
        return loss, torch.cat(parts), 1.0 if least is None else float(least)

    def _searched(
        self, closure: Callable[[], Any], state: dict[str, Any], at: _Found
    ) -> _Found | None:
        """One iteration: what is found after it; ``at`` itself if no step serves."""
        loss, g, det = at
        value, d = float(loss), self._direction(state, g)
        slope, length = float(g @ d), self.param_groups[0]["lr"]
        if not slope < 0:
            return at
        if not state["s"]:
            length = min(length, self.first_step / max(float(d.abs().max()), 1e-30))
        start = [f.coefficients.detach().clone() for f in self.fields]
        for _ in range(_TRIALS):
            self._move(start, length * d)
            found = self._evaluated(closure)
            if found is None:
                return None
            new = float(found[0])
            if new <= value + _SUFFICIENT * length * slope and found[2] >= min(det, 0.0):
                self._learn(state, length * d, found[1] - g)
                return found
            excess = new - value - length * slope  # of the parabola through both ends
            least = -slope * length**2 / (2 * excess) if excess > 0 else 0.5 * length
            length = min(max(least, 0.1 * length), 0.5 * length)
        for field, c in zip(self.fields, start, strict=True):
            field.coefficients.copy_(c)
        return at

    def _split(self, flat: Tensor) -> list[Tensor]:
        """A vector of all fields' coefficients on the level, by field, each (side², d)."""
        assert self._level is not None
        widths = [f.out_dim for f in self.fields]
        each = zip(self._level[1], widths, strict=True)
        sizes = [level.side**2 * width for level, width in each]
        parts = zip(flat.split(sizes), widths, strict=True)
        return [part.view(-1, width) for part, width in parts]

    def _move(self, start: list[Tensor], step: Tensor) -> None:
        assert self._level is not None
        each = zip(self.fields, start, self._level[1], self._split(step), strict=True)
        for field, c, level, part in each:
            field.coefficients.copy_(c + level.prolonged(part))

    def _preconditioned(self, g: Tensor) -> Tensor:
        assert self._level is not None
        each = zip(self._level[1], self._split(g), strict=True)
        return torch.cat([level.sobolev(level.sobolev(part)).flatten() for level, part in each])

    def _direction(self, state: dict[str, Any], g: Tensor) -> Tensor:
        """The two-loop recursion (Nocedal and Wright, Algorithm 7.4), from P Pᵀ."""
        q, shares = g.clone(), []
        pairs = list(zip(state["s"], state["y"], strict=True))
        for s, y in reversed(pairs):
            shares.append((s @ q) / (s @ y))
            q -= shares[-1] * y
        d = self._preconditioned(q)
        if pairs:
            s, y = pairs[-1]
            d *= (s @ y) / (y @ self._preconditioned(y))
        for s, y in pairs:
            d += (shares.pop() - (y @ d) / (s @ y)) * s
        return -d

    def _learn(self, state: dict[str, Any], s: Tensor, y: Tensor) -> None:
        if float(s @ y) > _FLAT * float(s.norm() * y.norm()):
            state["s"] = [*state["s"], s][-self.memory :]
            state["y"] = [*state["y"], y][-self.memory :]


def _ends(counts: Sequence[int]) -> list[int]:
    """The step at which each level but the first begins."""
    return list(accumulate(counts))
