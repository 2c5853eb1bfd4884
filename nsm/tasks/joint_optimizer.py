"""One optimizer that makes the steps of several, so that their trainings share a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor
from torch.optim import Optimizer

from nsm.tasks.optimizers import PARAMETERWISE, takes_matrices


def shared_options(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the settings of optimizers must have in common for :func:`in_one`; None: this one's step
    of a parameter may depend on other parameters, and it serves one training alone."""
    if settings["_target_"] not in PARAMETERWISE:
        return None
    own = () if takes_matrices(settings["_target_"]) else ("lr", "encoding_lr")
    return {key: value for key, value in settings.items() if key not in own}


def in_one(optimizers: Sequence[Optimizer]) -> Optimizer:
    """One optimizer that makes the steps of several, as each would.

    Where the rates are the same, its groups are those of the first, with the parameters of all;
    else each optimizer keeps its own groups, named ``NAME@i``.

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
    """What each of several optimizers has of the state of the one that makes all their steps.

    Args:
        joint: as :func:`in_one` makes it.
        each: those it replaces.
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
        """The state that the optimizer ``index`` would have alone."""
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
        """The joint optimizer's state, of what each has."""
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
