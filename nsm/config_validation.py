"""The settings that each choice takes, read off the code that takes them.

The groups whose keys depend on the choice (activation, encoding, energy, constraints, optimizer,
scheduler) are checked here against the signatures of what is built from them, and then by
building it once in small, so that a mistake is told before any work.
"""

from __future__ import annotations

import difflib
import inspect
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Union

import torch
from omegaconf import DictConfig, OmegaConf

from nsm.domains import DOMAINS
from nsm.domains.common_seams import SEAMS
from nsm.domains.embedding import METHODS
from nsm.energies import ENERGIES, Blend
from nsm.errors import NsmError
from nsm.maps import build_map
from nsm.maps.activations import ACTIVATIONS
from nsm.maps.encodings import ENCODINGS
from nsm.maps.networks import BLOCKS, INITIALIZATIONS, LINEAR_SKIPS
from nsm.results.loggers import LOGGERS, require
from nsm.tasks import Overfit, Param
from nsm.tasks.constrained import BOUNDARIES, LANDMARKS, Constraints
from nsm.tasks.optimizers import OPTIMIZERS, SCHEDULERS, build_optimizer, build_scheduler
from nsm.tasks.param import BOUNDARIES as PARAM_BOUNDARIES

ACCELERATORS = ("auto", "cpu", "gpu")


@dataclass(frozen=True)
class Parameter:
    """What a choice takes under a key: values of a type (anything if None), or words."""

    type: Any = None
    words: tuple[str, ...] = ()
    required: bool = False


Parameters = dict[str, Parameter]

# what every optimiser, and every schedule, takes beside its own parameters
_ALL_OPTIMIZERS: Parameters = {"encoding_lr": Parameter(float | None)}
_ALL_SCHEDULERS: Parameters = {"warmup": Parameter(int), "peak": Parameter(float)}


def check_choices(config: DictConfig) -> None:
    """Check what the types of :class:`nsm.config.Schema` leave open.

    Raises:
        NsmError: a key that the choice does not take, with the nearest that it does; a value of
            the wrong type; a word that is not known; settings of which nothing can be built.
    """
    settings: Any = OmegaConf.to_container(config)
    task = settings["task"]["name"]
    _one_of("task.name", task, TASK_CHOICES)
    for key, words in _WORDS.items():
        _one_of(key, OmegaConf.select(config, key), words)
    for kind in settings["logger"]["kinds"]:
        _one_of("logger.kinds", kind, LOGGERS)
        require(kind)
    for group, known in named().items():
        _check_named(group, settings[group], known)
    if settings["map"]["linear_skip"] == "fitted" and task != "overfit":
        raise NsmError(
            f"setting map.linear_skip: task={task} has no surface to fit; "
            "take initialization=random"
        )
    choice = TASK_CHOICES[task]
    if choice.constraints:
        held = settings["constraints"] or {}
        _check(f"task={task}", "constraints", held, choice.constraints)
    elif settings["constraints"] is not None:
        raise NsmError(f"setting constraints: task={task} has none; leave them out")
    _check(f"task={task}", "energy", settings["energy"], choice.energy)
    if "weights" in choice.energy:
        weights = {name: Parameter(float) for name in ENERGIES}
        _check("the energy", "energy.weights", settings["energy"]["weights"], weights)
    _build(settings, choice)


def parameters(function: Callable[..., Any], skip: int = 0) -> Parameters:
    """The parameters of a function or class by name, without the first ``skip``."""
    takes = list(inspect.signature(function).parameters.values())[skip:]
    try:
        hints = typing.get_type_hints(function.__init__ if inspect.isclass(function) else function)
    except (NameError, TypeError):  # annotations that cannot be resolved say nothing
        hints = {}
    return {
        p.name: Parameter(hints.get(p.name), required=p.default is inspect.Parameter.empty)
        for p in takes
        if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)
    }


def _lambdas(task: type) -> Parameters:
    return {k: p for k, p in parameters(task).items() if k.startswith("lambda_")}


@dataclass(frozen=True)
class TaskChoice:
    """What a task takes in the groups energy and constraints, and what they are built into."""

    energy: Parameters
    constraints: Parameters
    held: Callable[..., Any] | None = None


_WEIGHTS: Parameters = {"weights": Parameter(dict, required=True)}
_CONSTRAINTS: Parameters = {
    **parameters(Constraints),
    "boundary": Parameter(words=BOUNDARIES, required=True),
    "landmarks": Parameter(words=LANDMARKS, required=True),
}

TASK_CHOICES: dict[str, TaskChoice] = {
    "overfit": TaskChoice(_lambdas(Overfit), {}),
    "param": TaskChoice(
        _WEIGHTS,
        {**_lambdas(Param), "boundary": Parameter(words=PARAM_BOUNDARIES, required=True)},
    ),
    "pair_map": TaskChoice(_WEIGHTS, _CONSTRAINTS, Constraints),
    "collection_map": TaskChoice(_WEIGHTS, _CONSTRAINTS, Constraints),
}


def named() -> dict[str, dict[str, Parameters]]:
    """Group to name to what it takes, with what has been registered."""
    return {
        "activation": {
            name: {key: Parameter(float) for key in formulas.defaults}
            for name, formulas in ACTIVATIONS.items()
        },
        "encoding": {name: parameters(cls, skip=1) for name, cls in ENCODINGS.items()},
        "optimizer": {
            name: {**parameters(cls, skip=1), **_ALL_OPTIMIZERS} for name, cls in OPTIMIZERS.items()
        },
        "scheduler": {
            name: {**parameters(function, skip=1), **_ALL_SCHEDULERS}
            for name, function in SCHEDULERS.items()
        },
    }


_WORDS: dict[str, Iterable[str]] = {
    "domain": DOMAINS,
    "map.block": BLOCKS,
    "map.initialization": INITIALIZATIONS,
    "map.linear_skip": LINEAR_SKIPS,
    "surface.parameterization": METHODS,
    "seam.path": ("auto", *SEAMS),
    "trainer.accelerator": ACCELERATORS,
}


def _check_named(group: str, given: Mapping[str, Any], known: Mapping[str, Parameters]) -> None:
    if "name" not in given:
        raise NsmError(f"setting {group}.name: missing; choose one of {', '.join(known)}")
    _one_of(f"{group}.name", given["name"], known)
    rest = {key: value for key, value in given.items() if key != "name"}
    _check(f"{group}={given['name']}", group, rest, known[given["name"]])


def _check(what: str, group: str, given: Mapping[str, Any], known: Parameters) -> None:
    for key, value in given.items():
        if key not in known:
            raise NsmError(
                f"setting {group}.{key}: {what} takes no such setting; {_hint(key, known)}"
            )
        if known[key].words:
            _one_of(f"{group}.{key}", value, known[key].words)
        elif not _fits(value, known[key].type):
            raise NsmError(f"setting {group}.{key}: {value!r} is not {_called(known[key].type)}")
    for key, parameter in known.items():
        if parameter.required and key not in given:
            raise NsmError(f"setting {group}.{key}: {what} needs it; give +{group}.{key}=...")


def _one_of(key: str, value: Any, words: Iterable[str]) -> None:
    if value not in words:
        raise NsmError(f"setting {key}: {value!r} is not known; {_hint(str(value), words)}")


def _hint(word: str, known: Iterable[str]) -> str:
    known = list(known)
    if not known:
        return "it takes none"
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value from a YAML file is of an annotated type; numbers are lenient."""
    if kind is None or kind is Any:
        return True
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        return any(_fits(value, one) for one in inside)
    if kind is type(None):
        return value is None
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if origin is not None and issubclass(origin, Sequence):
        return isinstance(value, list) and all(_fits(item, inside[0]) for item in value)
    return isinstance(value, kind)


def _called(kind: Any) -> str:
    """A type as users know it."""
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        known = [_called(one) for one in inside if one is not torch.Tensor]
        return " or ".join(dict.fromkeys(known))
    if origin is not None and issubclass(origin, Sequence):
        return f"a list, each item {_called(inside[0])}"
    names: dict[Any, str] = {
        float: "a number",
        int: "a whole number",
        bool: "true or false",
        type(None): "null",
    }
    return names.get(kind, f"of type {getattr(kind, '__name__', kind)}")


def _build(settings: dict[str, Any], choice: TaskChoice) -> None:
    """Build in small what the settings say; what is wrong with values is known to the code."""
    with _told("map"), torch.random.fork_rng(devices=[]):
        chosen = {key: settings[key] for key in ("activation", "encoding")}
        network = build_map({**settings["map"], **chosen})
    with _told("optimizer"):
        optimizer = build_optimizer(network, settings["optimizer"])
    with _told("scheduler"):
        build_scheduler(optimizer, settings["scheduler"], settings["trainer"]["max_steps"])
    with _told("energy"):
        if "weights" in choice.energy:
            Blend(settings["energy"]["weights"])
    with _told("constraints"):
        if choice.held:
            choice.held(**settings["constraints"])


@contextmanager
def _told(group: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, KeyError, AttributeError, RuntimeError) as error:
        raise NsmError(f"setting {group}: {' '.join(str(error).split())}") from error
