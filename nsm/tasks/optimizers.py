"""Optimisers and learning-rate schedules by name, from plain settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR, LRScheduler


class MuonBesideAdam(Optimizer):
    """Muon (Jordan et al., 2024) for weight matrices, and Adam for all else, as one optimiser.

    Muon's steps are scaled to the size of Adam's, so that both take the same rates. State and
    groups are this optimiser's own; the two that make the steps look at them.

    Args:
        groups: as torch takes them; the first holds the matrices (2-D), the others what is Adam's.
        lr: learning rate of groups without one of their own.
        momentum, weight_decay: Muon's.
        betas, eps: Adam's.

    Raises:
        ValueError: torch is older than 2.9, the first that has Muon.
    """

    def __init__(
        self,
        groups: list[dict[str, Any]],
        lr: float,
        momentum: float = 0.95,
        weight_decay: float = 0.0,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        if not hasattr(torch.optim, "Muon"):
            raise ValueError("optimizer=muon needs torch 2.9 or later; take adam")
        muon = torch.optim.Muon(
            groups[:1],
            lr=lr,
            momentum=momentum,
            weight_decay=weight_decay,
            adjust_lr_fn="match_rms_adamw",
        )
        adam = torch.optim.Adam(groups[1:], lr=lr, betas=betas, eps=eps, fused=True)
        self._parts: tuple[Optimizer, Optimizer] = (muon, adam)
        super().__init__(muon.param_groups + adam.param_groups, {})
        self._share()

    def _share(self) -> None:
        parted = (self.param_groups[:1], self.param_groups[1:])
        for part, groups in zip(self._parts, parted, strict=True):
            part.param_groups, part.state = groups, self.state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Loading a state puts new groups in the place of the old."""
        super().__setstate__(state)
        self._share()

    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One step of both, after the closure (loss and gradients), whose value is given back."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self._parts:
            part.step()
        return loss


OPTIMIZERS: dict[str, Callable[..., Optimizer]] = {
    "adam": torch.optim.Adam,
    "adamw": torch.optim.AdamW,
    "rmsprop": torch.optim.RMSprop,
    "sgd": torch.optim.SGD,
    "lbfgs": torch.optim.LBFGS,
    "muon": MuonBesideAdam,
}
# those that torch offers as one operation for all parameters
_FUSED = ("adam", "adamw", "sgd")
# those that take one group of parameters, and so one learning rate
_WHOLE = ("lbfgs",)
# those whose first group is of the hidden layers' matrices alone
_BY_MATRIX = ("muon",)
# layers that give numbers that are not features of a network
_LAST = ("output", "linear_skip")
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
    if encoding_lr is not None and encoding_lr < 0:
        raise ValueError(f"optimizer.encoding_lr={encoding_lr} is negative")
    if name not in OPTIMIZERS:
        raise ValueError(f"optimizer {name!r} is not one of {', '.join(OPTIMIZERS)}")
    named = {key: p for key, p in module.named_parameters() if p.requires_grad}
    grids = [p for key, p in named.items() if ".tables." in key]
    matrices = [key for key, p in named.items() if name in _BY_MATRIX and _hidden_matrix(key, p)]
    others = [p for key, p in named.items() if ".tables." not in key and key not in matrices]
    # the names are those of the learning rates in the log
    if name in _WHOLE:
        others, grids = others + grids, []
    groups: list[dict[str, Any]] = [{"params": others, "name": "network"}]
    if name in _BY_MATRIX:
        if not matrices:
            raise ValueError(f"optimizer {name!r}: the network has no matrices; take adam")
        groups.insert(0, {"params": [named[key] for key in matrices], "name": "matrices"})
    if grids:
        rate = rest["lr"] if encoding_lr is None else encoding_lr
        groups.append({"params": grids, "lr": rate, "name": "encoding"})
    if name in _FUSED and not rest.get("foreach"):
        rest.setdefault("fused", True)
    try:
        return OPTIMIZERS[name](groups, **rest)
    except TypeError as error:
        raise ValueError(f"optimizer {name!r}: {error}") from error


def shared_options(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the settings of optimisers must have in common for :func:`in_one`; None: a step of this
    one depends on all that it is given, and it makes them for one training alone."""
    name = settings["name"]
    if name in _WHOLE:
        return None
    own = () if name in _BY_MATRIX else ("lr", "encoding_lr")
    return {key: value for key, value in settings.items() if key not in own}


def in_one(optimizers: Sequence[Optimizer]) -> Optimizer:
    """One optimiser that makes the steps of several, as each would.

    Groups are those of the first, with the parameters of all, where rates are the same; else each
    keeps its own, named ``NAME@i``.

    Args:
        optimizers: k of them that :func:`build_optimizer` made, with :func:`shared_options`.
    """
    every = [[_without_schedule(group) for group in one.param_groups] for one in optimizers]
    options = [[{**group, "params": None} for group in groups] for groups in every]
    if all(one == options[0] for one in options):
        groups = [
            {**same[0], "params": [p for group in same for p in group["params"]]}
            for same in zip(*every, strict=True)
        ]
    else:
        groups = [
            {**group, "name": f"{group['name']}@{i}"}
            for i, own in enumerate(every)
            for group in own
        ]
    kind: Any = type(optimizers[0])
    made: Optimizer = kind(groups, lr=groups[0]["lr"])
    return made


def _without_schedule(group: Mapping[str, Any]) -> dict[str, Any]:
    rest = dict(group)
    rate = rest.pop("initial_lr", rest["lr"])
    return {**rest, "lr": rate}


class Shares:
    """What each of several optimisers has of the state of the one that makes all their steps.

    Args:
        joint: as :func:`in_one` makes it.
        each: those it was made of.
    """

    def __init__(self, joint: Optimizer, each: Sequence[Optimizer]) -> None:
        place: dict[Tensor, tuple[int, int]] = {}  # of each parameter: number and group
        for number, group in enumerate(joint.param_groups):
            place.update({p: (len(place) + n, number) for n, p in enumerate(group["params"])})
        self._heads = [_head(group) for group in joint.state_dict()["param_groups"]]
        self._own_heads = [
            [_head(group) for group in one.state_dict()["param_groups"]] for one in each
        ]
        self._numbers = [
            [place[p][0] for group in one.param_groups for p in group["params"]] for one in each
        ]
        self._groups = [
            [place[group["params"][0]][1] for group in one.param_groups] for one in each
        ]

    def of_optimizer(self, state: Mapping[str, Any], index: int) -> dict[str, Any]:
        """The state that the optimiser ``index`` would have alone."""
        numbers = enumerate(self._numbers[index])
        heads = zip(self._groups[index], self._own_heads[index], strict=True)
        return {
            "state": {n: state["state"][own] for n, own in numbers if own in state["state"]},
            "param_groups": [{**state["param_groups"][g], **head} for g, head in heads],
        }

    def of_schedule(self, state: Mapping[str, Any], index: int) -> dict[str, Any]:
        """The same of the schedule's state, whose lists have an item for each group."""
        groups = self._groups[index]
        return {k: [v[g] for g in groups] if isinstance(v, list) else v for k, v in state.items()}

    def optimizer(self, states: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """The joint optimiser's state, of what each has."""
        owned = zip(self._numbers, states, strict=True)
        return {
            "state": {
                own: state["state"][n]
                for numbers, state in owned
                for n, own in enumerate(numbers)
                if n in state["state"]
            },
            "param_groups": [
                {**states[i]["param_groups"][g], **head}
                for (i, g), head in zip(self._owners(), self._heads, strict=True)
            ],
        }

    def schedule(self, states: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """The joint schedule's state, of what each has."""
        owners = self._owners()
        return {
            key: [states[i][key][g] for i, g in owners] if isinstance(value, list) else value
            for key, value in states[0].items()
        }

    def _owners(self) -> list[tuple[int, int]]:
        """Of each joint group: whose it is, of one of them, and its number there."""
        found: dict[int, tuple[int, int]] = {}
        for i, groups in enumerate(self._groups):
            for g, number in enumerate(groups):
                found.setdefault(number, (i, g))
        return [found[number] for number in range(len(self._heads))]


def _head(group: Mapping[str, Any]) -> dict[str, Any]:
    """What is a group's own in any state."""
    return {key: group[key] for key in ("params", "name")}


def _hidden_matrix(key: str, p: Tensor) -> bool:
    parts = key.split(".")
    return p.ndim == 2 and "tables" not in parts and not any(part in _LAST for part in parts)


def build_scheduler(optimizer: Optimizer, settings: dict[str, Any], max_steps: int) -> LRScheduler:
    """A schedule stepped after each training step.

    ``constant``; ``cosine``: one half-wave down to ``final`` of the rate at ``max_steps``;
    ``sgdr``: warm restarts every ``period`` steps, each ``period_factor`` times the one before
    (Loshchilov and Hutter, ICLR 2017). All rise linearly over the first ``warmup`` steps, and are
    ``peak`` (by default 1) times the optimiser's rates.

    Raises:
        ValueError: the schedule is not known or does not take a parameter.
    """
    rest = dict(settings)
    name, warmup, peak = rest.pop("name"), rest.pop("warmup", 0), rest.pop("peak", 1.0)
    if name not in SCHEDULERS:
        raise ValueError(f"scheduler {name!r} is not one of {', '.join(SCHEDULERS)}")
    for key, value in {**rest, "warmup": warmup, "peak": peak}.items():
        if value < 0:
            raise ValueError(f"scheduler.{key}={value} is negative")
    try:
        factor = SCHEDULERS[name](max_steps, **rest)
    except TypeError as error:
        raise ValueError(f"scheduler {name!r}: {error}") from error

    def share(step: int) -> float:
        return peak * min(1.0, (step + 1) / (warmup + 1)) * factor(step)

    return LambdaLR(optimizer, share)


def configure(module: nn.Module, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What Lightning wants of ``configure_optimizers``, from a task's hyperparameters.

    Raises:
        ValueError: as :func:`build_optimizer` and :func:`build_scheduler`.
    """
    return scheduled(build_optimizer(module, dict(settings["optimizer"])), settings)


def scheduled(optimizer: Optimizer, settings: Mapping[str, Any]) -> dict[str, Any]:
    """An optimiser with the schedule of a task's hyperparameters, as Lightning wants them."""
    scheduler = build_scheduler(optimizer, dict(settings["scheduler"]), settings["max_steps"])
    every_step = {"scheduler": scheduler, "interval": "step", "name": "learning_rate"}
    return {"optimizer": optimizer, "lr_scheduler": every_step}
