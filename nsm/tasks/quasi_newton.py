"""Quasi-Newton steps on the coefficients of splines, coarse levels first (METHOD)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from nsm.maps import SplineField
from nsm.stages import at as shown
from nsm.stages import part
from nsm.tasks.curvature import Curvature
from nsm.tasks.device_level import DeviceLevel
from nsm.tasks.limited_memory import LimitedMemory, Vector
from nsm.tasks.spline_level import Level

_SUFFICIENT = 1e-4  # Armijo's condition
_TRIALS = 14
_HALVED = 3  # trials at most by half; then a triangle folds within a short way
# relative gain of a step on the last level, below which the next ones gain nothing
_CONVERGED = 1e-4
# relative gain of a step, below which the next one goes on with what is known of the curvature
_NEAR = 0.1


class _Found(NamedTuple):
    """Loss and gradient on the level."""

    loss: Any
    value: float
    gradient: Vector


class QuasiNewton(Optimizer):
    """L-BFGS on the coefficients of splines, from the curvature of the loss at its points.

    A step begins with the matrix K of the loss's curvature (:class:`nsm.tasks.curvature.Curvature`)
    at the present coefficients, each component of a spline apart, with a little H¹ added; its
    factors, sparse ones on the CPU, are the metric in which L-BFGS begins. K is near enough to the
    Hessian that few iterations follow, and they correct what it leaves out. Backtracking along each
    direction ensures descent. After a step on the last level that gained little, K and what the
    iterations learned still hold, and the next step goes on with them.

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
        self._known: LimitedMemory | None = None  # of the curvature, from the last step
        self._stored: dict[str, Any] | None = None  # the same, as a checkpoint has it

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

    def begin_anew(self) -> None:
        """Forget what is known of the curvature: the loss is another one from here on."""
        self._known = self._stored = None

    def release(self) -> None:
        """Let go of the matrices, which are large; a further step makes them again."""
        self.begin_anew()
        self._level, self._moving = None, []

    def state_dict(self) -> dict[str, Any]:
        """As torch's, with what is known of the curvature, so that it goes on as it would have."""
        known = self._stored
        if self._known is not None:
            known = self._known.stored(self._moving[0][1].tensor)
        return {**super().state_dict(), "known": known}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self.begin_anew()
        self._stored = state_dict.get("known")  # an earlier version's has none

    @property
    def on_last_level(self) -> bool:
        """Whether the steps of all coarser levels have been made."""
        return bool(self.state[self.fields[0].coefficients]["step"] >= sum(self.counts))

    @property
    def _at_last_level(self) -> bool:
        """Whether the step that is made is on the last level."""
        return self._level is not None and self._level[0] == len(self.counts)

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
        state["converged"] = self._at_last_level and hardly
        if self.converged:
            self.begin_anew()
        return loss

    def _now(self) -> Vector:
        """The present coefficients on the level, of what moves."""
        return self._joined([level.restored(field.coefficients) for field, level in self._moving])

    def _descended(self, closure: Callable[[], Any], found: _Found) -> _Found | None:
        """What is found after the iterations, from what is found at the present coefficients."""
        at, began, known = self._now(), found.value, self._taken()
        if known is None:
            curvatures = self.curvatures()
            entries = self._entries(curvatures)
            known = LimitedMemory(self.memory, entries, self._inverse(entries), bool(curvatures))
        for k in range(self.iterations):
            shown("iteration", k, self.iterations, f"loss {found.value:.2e}")
            moved = self._searched(closure, known, at, found)
            if moved is None:
                return None
            at, found, stuck = moved
            if stuck and not known.forget():
                return found
        alone = len(self._moving) == len(self.fields)  # other parts change what this one minimizes
        if alone and self._at_last_level and began - found.value < _NEAR * abs(found.value):
            self._known = known
        return found

    def _taken(self) -> LimitedMemory | None:
        """What is known of the curvature from the step before, which is no longer kept."""
        found, stored = self._known, self._stored
        self.begin_anew()
        if stored is not None:
            found = self._restored(stored)
        if found is not None:
            found.goes_on = True
        return found

    def _restored(self, stored: dict[str, Any]) -> LimitedMemory:
        field, level = self._moving[0]

        def vector(tensor: Tensor) -> Vector:
            return level.vector(tensor.to(field.coefficients.device))

        entries = [vector(each) for each in stored["entries"]]
        found = LimitedMemory(self.memory, entries, self._inverse(entries), stored["known"])
        found.restore(stored, vector)
        return found

    def _evaluated(self, closure: Callable[[], Any], at: Vector) -> _Found | None:
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
        self, closure: Callable[[], Any], known: LimitedMemory, at: Vector, found: _Found
    ) -> tuple[Vector, _Found, bool] | None:
        """One iteration: the coefficients and what is found there, and whether no step serves."""
        d = -known.direction(found.gradient)
        slope, length = float(found.gradient @ d), known.first(d, self.first_length)
        for trial in range(_TRIALS if slope < 0 else 0):
            new = self._evaluated(closure, at + length * d)
            if new is None:
                return None
            if new.value <= found.value + _SUFFICIENT * length * slope:
                known.learn(length, d, new.gradient - found.gradient)
                return at + length * d, new, False
            excess = new.value - found.value - length * slope  # of the parabola through both ends
            least = -slope * length**2 / (2 * excess) if excess > 0 else 0.5 * length
            length = min(max(least, 0.1 * length), (0.5 if trial < _HALVED else 0.25) * length)
        self._put(at)
        return at, found, True

    def _entries(self, known: Sequence[Curvature]) -> list[Vector]:
        """Those of K on the level, at the present coefficients, of each field that moves."""
        seen: dict[int, list[Any]] = {id(field): [] for field, _ in self._moving}
        for curvature in known:
            field, x, blocks = curvature.of_field()
            seen[id(field)].append((x, blocks))
        return [level.entries(self.smoothing, seen[id(field)]) for field, level in self._moving]

    def _inverse(self, entries: Sequence[Vector]) -> Callable[[Vector], Vector]:
        """The inverse of K, given by its entries."""
        every = zip(self._moving, entries, strict=True)
        metrics = [level.metric(of_field) for (_, level), of_field in every]

        def solve(g: Vector) -> Vector:
            parts = zip(metrics, self._split(g), strict=True)
            return self._joined([metric.solve(part) for metric, part in parts])

        return solve

    def _split(self, flat: Vector) -> list[Vector]:
        """A vector of the coefficients on the level of what moves, by field, each (rows, d)."""
        parts, end = [], 0
        for _, level in self._moving:
            start, end = end, end + level.rows * level.out_dim
            parts.append(flat[start:end].reshape(-1, level.out_dim))
        return parts

    def _joined(self, parts: list[Vector]) -> Vector:
        """The inverse of :meth:`_split`."""
        return self._moving[0][1].joined(parts)

    def _put(self, at: Vector) -> None:
        for (field, level), c in zip(self._moving, self._split(at), strict=True):
            field.coefficients.copy_(level.tensor(level.up @ c))


def level_of(field: SplineField, cells: int) -> Level | DeviceLevel:
    """A level of a field, for the device where the field is."""
    level, device = Level(field, cells), field.coefficients.device
    return level if device.type == "cpu" else DeviceLevel(level, device)
