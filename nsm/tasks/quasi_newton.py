"""Quasi-Newton steps on the coefficients of splines, coarse levels first (METHOD)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import nn
from torch.optim import Optimizer

from nsm.maps import SplineField
from nsm.stages import at as shown
from nsm.stages import part
from nsm.tasks.curvature import Curvature
from nsm.tasks.device_level import DeviceLevel
from nsm.tasks.spline_level import Level

_SUFFICIENT = 1e-4  # Armijo's condition
_TRIALS = 14
_HALVED = 3  # trials at most by half; then a triangle folds within a short way
_FLAT = 1e-10  # pairs of less curvature say nothing
# largest change of a coefficient in the first iteration of a step without known curvature
_FIRST = 0.02
# relative gain of a step on the last level, below which the next ones gain nothing
_CONVERGED = 1e-4


# of double precision: an array of numpy for the CPU, a tensor on any other device
_Vector = Any


class _Found(NamedTuple):
    """Loss and gradient on the level."""

    loss: Any
    value: float
    gradient: _Vector


class QuasiNewton(Optimizer):
    """L-BFGS on the coefficients of splines, from the curvature of the loss at its points.

    A step begins with the matrix K of the loss's curvature (:class:`nsm.tasks.curvature.Curvature`)
    at the present coefficients, each component of a spline apart, with a little H¹ added; its
    factors, sparse ones on the CPU, are the metric in which L-BFGS begins. K is near enough to the
    Hessian that few iterations follow, and they correct what it leaves out. Backtracking along each
    direction ensures descent.

    A level of n × n cells is a subspace of the finest grid by the two-scale relation of B-splines,
    so a finer level begins with the same function.

    The loss is minimized plus ``smoothing`` times the mean squared change of the splines' first
    derivatives over a cell: points, which are fixed in a step, say nothing about what lies between
    them.

    Args:
        params: the coefficients of all ``fields``.
        fields: the splines.
        levels: cells along each axis of each level, from coarse to fine; the finest are those of
            the fields, the others these divided by powers of two.
        steps: of each level but the last, which lasts until the end. Fields that are not zero, as
            in a further training, have the last level alone.
        iterations: of L-BFGS in a step.
        memory: pairs of steps and changes of the gradient that are kept.
        smoothing: weight of the smoothness.
        lr: the length that the line search tries first, in quasi-Newton steps.

    Raises:
        ValueError: a parameter is out of range, or a level does not fit a field.
    """

    def __init__(
        self,
        params: Iterable[Any],
        fields: Sequence[SplineField],
        levels: Sequence[int],
        steps: Sequence[int],
        iterations: int = 20,
        memory: int = 12,
        smoothing: float = 0.1,
        lr: float = 1.0,
    ) -> None:
        if len(steps) != len(levels) - 1 or min(steps, default=0) < 0:
            raise ValueError("optimizer.steps has one number, 0 or more, per level but the last")
        if min(iterations, memory) < 1 or not (smoothing >= 0 and lr > 0):
            raise ValueError(
                "optimizer.iterations, memory and lr must be above 0, smoothing not below"
            )
        super().__init__(params, {"lr": lr})
        held = [p for group in self.param_groups for p in group["params"]]
        if {id(p) for p in held} != {id(f.coefficients) for f in fields}:
            raise ValueError("optimizer=quasi_newton trains splines alone; take map=spline with it")
        self.fields, self.levels, self.counts = list(fields), list(levels), list(steps)
        for cells in levels:
            for field in fields:
                if cells < 3 or field.cells % cells or (field.cells // cells).bit_count() != 1:
                    Level(field, cells)  # says what is wrong
        self.iterations, self.memory, self.smoothing = iterations, memory, smoothing
        self.curvatures: Callable[[], Sequence[Curvature]] = lambda: []
        self.turns: Callable[[], Iterable[nn.Module]] = lambda: [nn.ModuleList(fields)]
        fresh = not any(f.coefficients.detach().count_nonzero() for f in fields)
        self.state[self.fields[0].coefficients]["step"] = 0 if fresh else sum(steps)
        self._level: tuple[int, list[Level | DeviceLevel]] | None = None
        self._moving: list[tuple[SplineField, Level | DeviceLevel]] = []

    def watch(
        self,
        curvatures: Callable[[], Sequence[Curvature]],
        turns: Callable[[], Iterable[nn.Module]],
    ) -> None:
        """Take the functions that say what a step minimizes.

        Args:
            curvatures: gives the curvature of the loss as it was last evaluated.
            turns: gives what a step moves, one part after the other: modules with fields.
        """
        self.curvatures, self.turns = curvatures, turns

    @property
    def on_last_level(self) -> bool:
        """Whether the steps of all coarser levels have been made."""
        return bool(self.state[self.fields[0].coefficients]["step"] >= sum(self.counts))

    @property
    def converged(self) -> bool:
        """Whether the last step was one of the last level and hardly changed the loss."""
        return bool(self.state[self.fields[0].coefficients].get("converged", False))

    @property
    def first_length(self) -> float:
        """The length that the line search tries first, in quasi-Newton steps."""
        return float(self.param_groups[0]["lr"])

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """The iterations of a step, of each part that takes its turn.

        Args:
            closure: evaluates loss and gradients at the present coefficients.

        Returns:
            The loss after the step, as the last part sees it.
        """
        assert closure is not None, "L-BFGS evaluates the loss more than once in a step"
        state = self.state[self.fields[0].coefficients]
        number = sum(state["step"] >= end for end in accumulate(self.counts))
        if self._level is None or self._level[0] != number:
            self._level = number, [level_of(f, self.levels[number]) for f in self.fields]
        state["step"] += 1
        loss, hardly = None, True
        for k, moving in enumerate(self.turns()):
            own = [module for module in moving.modules() if isinstance(module, SplineField)]
            each = zip(self.fields, self._level[1], strict=True)
            self._moving = [(field, level) for field, level in each if field in own]
            maps = len(self.fields) // len(own)
            with part(f"map {k + 1}/{maps}" if maps > 1 else "quasi-Newton step"):
                before = self._evaluated(closure, self._now())
                after = None if before is None else self._descended(closure, before)
            if before is None or after is None:  # rolled back from a loss that is not finite
                return None
            hardly &= before.value - after.value <= _CONVERGED * abs(before.value)
            loss = after.loss
        state["converged"] = number == len(self.counts) and hardly
        return loss

    def _now(self) -> _Vector:
        """The present coefficients on the level, of what moves."""
        return self._joined([level.restored(field.coefficients) for field, level in self._moving])

    def _descended(self, closure: Callable[[], Any], found: _Found) -> _Found | None:
        """What is found after the iterations, from what is found at the present coefficients."""
        at, known = self._now(), self.curvatures()
        search = _Search(self.memory, self._metric(known), bool(known))
        for k in range(self.iterations):
            shown("iteration", k, self.iterations, f"loss {found.value:.2e}")
            moved = self._searched(closure, search, at, found)
            if moved is None:
                return None
            at, found, stuck = moved
            if stuck and not search.forget():
                break
        return found

    def _evaluated(self, closure: Callable[[], Any], at: _Vector) -> _Found | None:
        """Loss and gradient at coefficients of the level; None if the step was rolled back."""
        self._put(at)
        with torch.enable_grad():
            loss = closure()
        gradients = [
            f.coefficients.grad for f, _ in self._moving if f.coefficients.grad is not None
        ]
        if loss is None or len(gradients) < len(self._moving):
            return None
        value, parts = self._moving[0][1].vector(torch.as_tensor(loss, dtype=torch.float64)), []
        for (_, level), g, c in zip(self._moving, gradients, self._split(at), strict=True):
            rough = level.smoothness @ c
            value = value + self.smoothing * (c * rough).sum()
            parts.append(level.down @ level.vector(g) + 2 * self.smoothing * rough)
        return _Found(loss, float(value), self._joined(parts))

    def _searched(
        self, closure: Callable[[], Any], search: _Search, at: _Vector, found: _Found
    ) -> tuple[_Vector, _Found, bool] | None:
        """One iteration: the coefficients and what is found there, and whether no step serves."""
        d = -search.direction(found.gradient)
        slope, length = float(found.gradient @ d), search.first(d, self.first_length)
        for trial in range(_TRIALS if slope < 0 else 0):
            new = self._evaluated(closure, at + length * d)
            if new is None:
                return None
            if new.value <= found.value + _SUFFICIENT * length * slope:
                search.learn(length * d, new.gradient - found.gradient)
                return at + length * d, new, False
            excess = new.value - found.value - length * slope  # of the parabola through both ends
            least = -slope * length**2 / (2 * excess) if excess > 0 else 0.5 * length
            length = min(max(least, 0.1 * length), (0.5 if trial < _HALVED else 0.25) * length)
        self._put(at)
        return at, found, True

    def _metric(self, known: Sequence[Curvature]) -> Callable[[_Vector], _Vector]:
        """The inverse of K on the level, at the present coefficients."""
        seen: dict[int, list[Any]] = {id(field): [] for field, _ in self._moving}
        for curvature in known:
            field, x, blocks = curvature.of_field()
            seen[id(field)].append((x, blocks))
        metrics = [level.metric(self.smoothing, seen[id(f)]) for f, level in self._moving]

        def solve(g: _Vector) -> _Vector:
            parts = zip(metrics, self._split(g), strict=True)
            return self._joined([metric.solve(part) for metric, part in parts])

        return solve

    def _split(self, flat: _Vector) -> list[_Vector]:
        """A vector of the coefficients on the level of what moves, by field, each (rows, d)."""
        parts, end = [], 0
        for _, level in self._moving:
            start, end = end, end + level.rows * level.out_dim
            parts.append(flat[start:end].reshape(-1, level.out_dim))
        return parts

    def _joined(self, parts: list[_Vector]) -> _Vector:
        """The inverse of :meth:`_split`."""
        return self._moving[0][1].joined(parts)

    def _put(self, at: _Vector) -> None:
        for (field, level), c in zip(self._moving, self._split(at), strict=True):
            field.coefficients.copy_(level.tensor(level.up @ c))


def level_of(field: SplineField, cells: int) -> Level | DeviceLevel:
    """A level of a field, for the device where the field is."""
    level, device = Level(field, cells), field.coefficients.device
    return level if device.type == "cpu" else DeviceLevel(level, device)


class _Search:
    """The two-loop recursion (Nocedal and Wright, Algorithm 7.4) from the inverse of a metric."""

    def __init__(self, memory: int, solve: Callable[[_Vector], _Vector], known: bool) -> None:
        self.memory, self.solve, self.known = memory, solve, known
        self.pairs: list[tuple[_Vector, _Vector, Any]] = []  # s, y and their product
        self.scale: Any = 1.0

    def direction(self, g: _Vector) -> _Vector:
        """The inverse of the approximate Hessian times a gradient."""
        q, shares = 1.0 * g, []  # a copy
        for s, y, product in reversed(self.pairs):
            shares.append((s @ q) / product)
            q -= shares[-1] * y
        d = self.scale * self.solve(q)
        for s, y, product in self.pairs:
            d += (shares.pop() - (y @ d) / product) * s
        return d

    def first(self, d: _Vector, lr: float) -> float:
        """The first length to be tried along a direction."""
        if self.known or self.pairs:
            return lr
        return min(lr, _FIRST / max(float(abs(d).max()), 1e-30))

    def learn(self, s: _Vector, y: _Vector) -> None:
        """Take a step and the change of the gradient."""
        product = s @ y
        if product > _FLAT * ((s @ s) * (y @ y)) ** 0.5:
            if not self.pairs:
                self.scale = product / (y @ self.solve(y))
            self.pairs = [*self.pairs, (s, y, product)][-self.memory :]

    def forget(self) -> bool:
        """Begin again from the metric; False if nothing was learned."""
        learned = bool(self.pairs)
        self.pairs = []
        return learned
