"""Optimizers from settings: groups of parameters, their rates, and Muon."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from nsm.errors import NsmError
from nsm.instantiation import made, made_with, named_object, target_of
from nsm.maps import SplineField
from nsm.tasks.quasi_newton import QuasiNewton
from nsm.tasks.schedules import scheduled


class MuonBesideAdam(Optimizer):
    """Muon (Jordan et al., 2024) for weight matrices, and Adam for all else, as one optimizer.

    Muon's steps are scaled to the size of Adam's, so that both take the same rates. State and
    groups are this optimizer's own; the two that make the steps look at them.

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


# optimizers whose step of a parameter depends on that parameter's gradient and state alone
PARAMETERWISE = (
    *(f"torch.optim.{name}" for name in ("Adam", "AdamW", "NAdam", "RAdam", "RMSprop", "SGD")),
    target_of(MuonBesideAdam),
)
# layers whose outputs are not features of the network
_LAST = ("output", "linear_skip")


def takes_matrices(target: str) -> bool:
    """Whether an optimizer's first group is that of the hidden layers' matrices alone."""
    return target == target_of(MuonBesideAdam)


def build_optimizer(
    module: nn.Module, settings: Mapping[str, Any], max_steps: int = 0
) -> Optimizer:
    """The optimizer of a training.

    Args:
        module: whose parameters are trained; those of a ``tables`` list (feature grids, each
            entry of which sees few samples in a step) take ``encoding_lr``, if it is given.
        settings: ``_target_`` and the optimizer's own parameters, ``lr`` and ``encoding_lr``.
        max_steps: length of the training.

    Raises:
        NsmError: a rate is negative, or the optimizer does not accept its parameters.
    """
    rest = dict(settings)
    encoding_lr = rest.pop("encoding_lr", None)
    if encoding_lr is not None and encoding_lr < 0:
        raise NsmError(
            f"setting optimizer.encoding_lr: {encoding_lr} is negative",
            kind="out_of_range",
            key="optimizer.encoding_lr",
        )
    named = {key: p for key, p in module.named_parameters() if p.requires_grad}
    by_matrix = takes_matrices(rest["_target_"])
    grids = [p for key, p in named.items() if ".tables." in key]
    matrices = [key for key, p in named.items() if by_matrix and _hidden_matrix(key, p)]
    others = [p for key, p in named.items() if ".tables." not in key and key not in matrices]
    kind = named_object(rest["_target_"])
    if inspect.isclass(kind) and issubclass(kind, QuasiNewton):
        return _quasi_newton(module, rest, max_steps)
    if kind is torch.optim.LBFGS:  # takes one group of parameters, and so one learning rate
        others, grids = others + grids, []
    # the names are those of the learning rates in the log
    groups: list[dict[str, Any]] = [{"params": others, "name": "network"}]
    if by_matrix:
        if not matrices:
            raise NsmError(
                "setting optimizer: the network has no matrices for Muon; take optimizer=adam",
                kind="out_of_range",
                key="optimizer",
            )
        groups.insert(0, {"params": [named[key] for key in matrices], "name": "matrices"})
    if grids:
        group = {"params": grids, "name": "encoding"}
        rate = rest.get("lr") if encoding_lr is None else encoding_lr
        groups.append(group if rate is None else {**group, "lr": rate})
    # one operation for all parameters, where torch has it
    if kind in (torch.optim.Adam, torch.optim.AdamW, torch.optim.SGD) and not rest.get("foreach"):
        rest.setdefault("fused", True)
    return made(rest, groups)  # type: ignore[no-any-return]


def _quasi_newton(module: nn.Module, settings: Mapping[str, Any], max_steps: int) -> Optimizer:
    fields = [part for part in module.modules() if isinstance(part, SplineField)]
    trained = [p for p in module.parameters() if p.requires_grad]
    if len(fields) != len(trained):
        raise NsmError(
            "setting optimizer: quasi-Newton steps train splines alone; take map=spline, or "
            "experiment=adam with a network",
            kind="unsuitable_network",
            key="optimizer",
        )
    group = {"params": trained, "name": "spline"}
    offered = {"params": [group], "fields": fields, "max_steps": max_steps}
    return made_with(settings, **offered)  # type: ignore[no-any-return]


def _hidden_matrix(key: str, p: Tensor) -> bool:
    parts = key.split(".")
    return p.ndim == 2 and "tables" not in parts and not any(part in _LAST for part in parts)


def configure(module: nn.Module, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What Lightning expects of ``configure_optimizers``, from a task's hyperparameters.

    Raises:
        NsmError: as :func:`build_optimizer` and :func:`nsm.tasks.schedules.build_scheduler`.
    """
    return scheduled(
        build_optimizer(module, settings["optimizer"], settings["max_steps"]), settings
    )
