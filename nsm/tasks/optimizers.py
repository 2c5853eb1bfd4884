"""Optimisers and learning-rate schedules by name, from plain settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler

OPTIMIZERS: dict[str, Callable[..., Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "rmsprop": torch.optim.RMSprop,
    "sgd": torch.optim.SGD,
    "lbfgs": torch.optim.LBFGS,
}
# those that torch offers as one operation for all parameters
_FUSED = ("adam", "adamw", "sgd")
# those that take one group of parameters, and so one learning rate
_WHOLE = ("lbfgs",)
Factor = Callable[[float], float]  # of the step: share of the full learning rate


def _constant(max_steps: int) -> Factor:
    return lambda step: 1.0


def _cosine(max_steps: int, final: float = 0.0) -> Factor:
    return lambda step: _wave(min(1.0, step / max(1, max_steps)), final)


def _sgdr(max_steps: int, period: float, period_factor: float = 1.0, final: float = 0.0) -> Factor:
    if period <= 0 or period_factor <= 0:
        raise ValueError("scheduler.period and scheduler.period_factor must be positive")

    def factor(step: float) -> float:
        length = float(period)
        while step >= length:
            step -= length
            length *= period_factor
        return _wave(step / length, final)

    return factor


def _wave(share: float, final: float) -> float:
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * share))


SCHEDULERS: dict[str, Callable[..., Factor]] = {
    "constant": _constant,
    "cosine": _cosine,
    "sgdr": _sgdr,
}


def build_optimizer(module: nn.Module, settings: dict[str, Any]) -> Optimizer:
    """The optimiser that settings name.

    Args:
        module: whose parameters are trained; those of a ``tables`` list (feature grids, each
            entry of which sees few samples a step) take ``encoding_lr`` where that is given.
        settings: ``name``, ``lr``, ``encoding_lr`` (or None) and the optimiser's own parameters.

    Raises:
        ValueError: the optimiser is not known or does not take a parameter.
    """
    rest = dict(settings)
    name, encoding_lr = rest.pop("name"), rest.pop("encoding_lr", None)
    if name not in OPTIMIZERS:
        raise ValueError(f"optimizer {name!r} is not one of {', '.join(OPTIMIZERS)}")
    named = [(key, p) for key, p in module.named_parameters() if p.requires_grad]
    grids = [p for key, p in named if ".tables." in key]
    others = [p for key, p in named if ".tables." not in key]
    # the names are those of the learning rates in the log
    if name in _WHOLE:
        others, grids = others + grids, []
    groups: list[dict[str, Any]] = [{"params": others, "name": "network"}]
    if grids:
        groups.append({"params": grids, "lr": encoding_lr or rest["lr"], "name": "encoding"})
    if name in _FUSED and not rest.get("foreach"):
        rest.setdefault("fused", True)
    try:
        return OPTIMIZERS[name](groups, **rest)
    except TypeError as error:
        raise ValueError(f"optimizer {name!r}: {error}") from error


def build_scheduler(optimizer: Optimizer, settings: dict[str, Any], max_steps: int) -> LRScheduler:
    """A schedule stepped after each training step.

    ``constant``; ``cosine``: one half-wave down to ``final`` of the rate at ``max_steps``;
    ``sgdr``: warm restarts every ``period`` steps, each ``period_factor`` times the one before
    (Loshchilov and Hutter, ICLR 2017). All rise linearly over the first ``warmup`` steps.

    Raises:
        ValueError: the schedule is not known or does not take a parameter.
    """
    rest = dict(settings)
    name, warmup = rest.pop("name"), rest.pop("warmup", 0)
    if name not in SCHEDULERS:
        raise ValueError(f"scheduler {name!r} is not one of {', '.join(SCHEDULERS)}")
    try:
        factor = SCHEDULERS[name](max_steps, **rest)
    except TypeError as error:
        raise ValueError(f"scheduler {name!r}: {error}") from error
    return LambdaLR(optimizer, lambda step: min(1.0, (step + 1) / (warmup + 1)) * factor(step))


def configure(module: nn.Module, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What Lightning wants of ``configure_optimizers``, from a task's hyperparameters.

    Raises:
        ValueError: as :func:`build_optimizer` and :func:`build_scheduler`.
    """
    optimizer = build_optimizer(module, dict(settings["optimizer"]))
    scheduler = build_scheduler(optimizer, dict(settings["scheduler"]), settings["max_steps"])
    every_step = {"scheduler": scheduler, "interval": "step", "name": "learning_rate"}
    return {"optimizer": optimizer, "lr_scheduler": every_step}
