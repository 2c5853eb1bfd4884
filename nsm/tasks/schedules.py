"""Learning-rate schedules, stepped after each training step.

Each is a share of the optimizer's rates: ``peak`` times a linear rise over the first ``warmup``
steps times the schedule's own course. Any scheduler of torch does as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

from nsm.errors import NsmError
from nsm.instantiation import made_with
from nsm.settings import Count, Share, Weight, Whole

Course = Callable[[float], float]  # of the step: share of the full rate


class Constant(LambdaLR):
    """The full rate from the first step to the last.

    Args:
        optimizer: whose rates are scheduled.
        warmup: steps of linear rise at the start.
        peak: share of the optimizer's rates that is the full rate.

    Raises:
        NsmError: a negative number.
    """

    def __init__(self, optimizer: Optimizer, warmup: Whole = 0, peak: Weight = 1.0) -> None:
        super().__init__(optimizer, _share(lambda step: 1.0, warmup, peak))


class Cosine(LambdaLR):
    """One half-wave from the full rate to ``final`` of it at its end.

    Args:
        optimizer: whose rates are scheduled.
        max_steps: length of the training.
        warmup: steps of linear rise at the start.
        final: share of the full rate at the end of the wave.
        peak: share of the optimizer's rates that is the full rate.
        until: share of the steps at which the wave ends.

    Raises:
        NsmError: a negative number.
    """

    def __init__(
        self,
        optimizer: Optimizer,
        max_steps: int,
        warmup: Whole = 0,
        final: Share = 0.0,
        peak: Weight = 1.0,
        until: Share = 1.0,
    ) -> None:
        _check(final=final, until=until)

        def course(step: float) -> float:
            return _wave(min(1.0, step / max(1, until * max_steps)), final)

        super().__init__(optimizer, _share(course, warmup, peak))


class SGDR(LambdaLR):
    """Warm restarts: half-waves from the full rate to ``final`` of it (Loshchilov and Hutter,
    ICLR 2017).

    With ``max_steps`` all waves are stretched by one factor, the one nearest to 1 for which the
    last wave ends with the training: a training that ends within a wave ends at a high rate.

    Args:
        optimizer: whose rates are scheduled.
        max_steps: length of the training; None: waves are not stretched.
        period: steps of the first wave, before stretching.
        period_factor: length of each wave relative to the one before, at least 1.
        final: share of the full rate at the end of a wave.
        warmup: steps of linear rise at the start.
        peak: share of the optimizer's rates that is the full rate.

    Raises:
        NsmError: a negative number, a period of zero, or a factor below 1.
    """

    def __init__(
        self,
        optimizer: Optimizer,
        max_steps: int | None = None,
        period: Count = 1000,
        period_factor: float = 2.0,
        final: Share = 0.0,
        warmup: Whole = 0,
        peak: Weight = 1.0,
    ) -> None:
        _check(final=final)
        if not period > 0:
            raise _out_of_range("period", f"{period} is not above 0")
        if not period_factor >= 1:  # waves that shrink would end before the training does
            raise _out_of_range("period_factor", f"{period_factor} is not at least 1")

        self.first = period if max_steps is None else _stretched(period, period_factor, max_steps)
        self.factor = period_factor

        def course(step: float) -> float:
            done, length = self._place(step)
            return _wave(done / length, final)

        super().__init__(optimizer, _share(course, warmup, peak))

    def _place(self, step: float) -> tuple[float, float]:
        """How many steps of its wave are done, and how many the wave has."""
        length = float(self.first)
        while step >= length - 1e-6 * self.first:  # rounding of a stretched wave
            step -= length
            length *= self.factor
        return max(0.0, step), length

    def wave_ends(self, step: int) -> bool:
        """Whether a wave ends with ``step`` steps done, so that a training may stop there."""
        return step > 0 and self._place(step)[0] < 1


def _stretched(period: float, factor: float, max_steps: int) -> float:
    """The period for which the waves nearest in length to ``max_steps`` last exactly so long."""
    total, length = float(period), float(period)
    while total + length * factor <= max_steps:
        length *= factor
        total += length
    longer = total + length * factor
    # nearer as a ratio: stretched and compressed alike
    best = longer if total * longer < float(max_steps) ** 2 else total
    return period * max_steps / best


def _wave(share: float, final: float) -> float:
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * share))


def _share(course: Course, warmup: int, peak: float) -> Course:
    _check(warmup=warmup, peak=peak)
    return lambda step: peak * min(1.0, (step + 1) / (warmup + 1)) * course(step)


def _check(**settings: float) -> None:
    for key, value in settings.items():
        if not value >= 0:
            raise _out_of_range(key, f"{value} is negative")


def _out_of_range(key: str, reason: str) -> NsmError:
    key = f"scheduler.{key}"
    return NsmError(f"setting {key}: {reason}", kind="out_of_range", key=key)


def build_scheduler(
    optimizer: Optimizer, settings: Mapping[str, Any], max_steps: int
) -> LRScheduler:
    """The schedule of a training, made with the optimizer and, if it takes it, ``max_steps``.

    Raises:
        NsmError: it cannot be made of its settings.
    """
    scheduler: LRScheduler = made_with(settings, optimizer=optimizer, max_steps=max_steps)
    return scheduler


def scheduled(optimizer: Optimizer, settings: Mapping[str, Any]) -> dict[str, Any]:
    """An optimizer with the schedule of a task's hyperparameters, as Lightning expects them."""
    scheduler = build_scheduler(optimizer, settings["scheduler"], settings["max_steps"])
    every_step = {"scheduler": scheduler, "interval": "step", "name": "learning_rate"}
    return {"optimizer": optimizer, "lr_scheduler": every_step}
