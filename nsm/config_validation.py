"""Check a composed configuration against the signatures of what it names, and complete it.

A mistake shows here, in one line with the nearest name, before any work begins.
"""

from __future__ import annotations

import difflib
import math
import random
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from nsm.config import COLLECTIONS, GROUPS, setting_error, unknown_setting
from nsm.errors import NsmError
from nsm.instantiation import made, named_object
from nsm.migration import check_weights
from nsm.plugins import import_plugins
from nsm.settings import Misfit, Parameter, Settings, fit, parameters, parts

# parameters of a group's target that come from the program, not from settings
SUPPLIED: dict[str, tuple[str, ...]] = {
    "map": ("out_dim", "activation", "encoding"),
    "encoding": ("in_dim",),
    "data": ("surface", "surfaces", "starts", "sampler", "seed"),
    "optimizer": ("params", "groups", "fields", "max_steps"),
    "scheduler": ("optimizer", "max_steps"),
    "logger": ("folder", "first_step", "every"),
}
# settings of ours beside the parameters of a group's target
EXTRA: dict[str, dict[str, Parameter]] = {
    "optimizer": {
        "encoding_lr": Parameter(
            float | None, None, "rate of feature grids, whose entries see few samples in a step"
        )
    },
    "loss_terms": {"weight": Parameter(float, remark="what the term is multiplied by")},
    "task": {"name": Parameter(str | None, None, "its name in folders and messages")},
}
# settings that initialization and experiment=quick give to others: a target that lacks them goes
# without
_FROM_OTHER_GROUPS = (
    "map.linear_skip",
    "scheduler.peak",
    "encoding.resolutions",
    "data.batch_size",
    "data.steps_per_epoch",
)
_HYDRA_KEYS = ("_target_", "_partial_", "_convert_", "_recursive_", "_args_")
_LARGEST_NUMBER = 2**63 - 1  # that whole numbers of 64 bits hold


def checked(config: DictConfig, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration resolved, checked, and completed with the defaults of nsm's classes.

    Args:
        config: as composed, or as a run has stored it.
        overrides: those that the user gave. Where they replace the ``_target_`` of an option, the
            option's own parameters that the new target lacks are left out.

    Raises:
        NsmError: a setting that does not exist or is missing, a value of the wrong type or out of
            range, or settings of which nothing can be made.
    """
    import_plugins()  # the jobs of a sweep may run in processes of their own
    try:
        settings: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise setting_error(error) from error
    _check_values("", settings)
    given = {override.lstrip("+").partition("=")[0] for override in overrides}
    known, _ = parameters(Settings)
    everything = {**known, **dict.fromkeys((*GROUPS, "logger", "loss_weights", "constraints"))}
    for key in settings:
        if key not in everything:
            raise unknown_setting(key)
    result: dict[str, Any] = {}
    for key in GROUPS:
        absent = key == "energy" and not settings.get(key)
        result[key] = None if absent else _target(key, key, settings.get(key), given)
    for key in COLLECTIONS:
        result[key] = {
            name: _target(f"{key}.{name}", key, node, given)
            for name, node in _mapping(key, settings.get(key) or {}).items()
        }
    for key, parameter in known.items():
        if key in COLLECTIONS:
            continue
        if key in parts():
            result[key] = _part(key, settings.get(key) or {}, parameters(parameter.kind)[0])
        else:
            result[key] = _fit(key, settings.get(key, parameter.default), parameter)
    task = named_object(result["task"]["_target_"])
    result["task"]["name"] = result["task"]["name"] or task.__name__.lower()
    module = getattr(task, "module", None)
    for key, name in (("constraints", "Constraints"), ("loss_weights", "Weights")):
        result[key] = _of_task(key, settings.get(key), getattr(module, name, None), result)
    _check_parts_of_map(result["map"]["_target_"], given)
    _build(result)
    if result["phi"]["overrides"]:
        from nsm.config import compose_config

        compose_config(["task=overfit", *result["phi"]["overrides"]])
    order = [key for key in (*GROUPS, *everything) if key in result]
    return OmegaConf.create({key: result[key] for key in dict.fromkeys(order)})


def _check_parts_of_map(target: str, given: Iterable[str]) -> None:
    """NsmError for an activation or encoding that is given beside a map which has none."""
    known, others = parameters(_imported("map._target_", target))
    for group in ("activation", "encoding"):
        mine = [key for key in given if key == group or key.startswith(f"{group}.")]
        if mine and not others and group not in known:
            raise NsmError(
                f"{mine[0]}: {target} has no {group}; omit it, or choose a network by map=mlp (for "
                "a map of two surfaces with experiment=adam)",
                kind="conflicting_settings",
                key=mine[0],
            )


def _target(key: str, group: str, node: Any, given: Iterable[str]) -> dict[str, Any]:
    """A checked node with ``_target_``, at a key, of a group."""
    settings = _mapping(key, node or {})
    name = settings.get("_target_")
    if not isinstance(name, str):
        hint = f"give {key}._target_=MODULE.CLASS"
        if key == group:
            hint = f"choose {group}=OPTION, or {hint}"
        raise NsmError(f"setting {key}: missing; {hint}", kind="missing_setting", key=key)
    known, others = takes(group, _imported(f"{key}._target_", name))
    retargeted = f"{key}._target_" in given or f"{group}._target_" in given
    result = {"_target_": name}
    for k, value in settings.items():
        dotted = f"{key}.{k}"
        if k in _HYDRA_KEYS:
            result[k] = value
        elif k in known:
            result[k] = _fit(dotted, value, known[k])
        elif others and (dotted in given or not retargeted):
            result[k] = _nested(dotted, value)
        elif dotted in given or not (retargeted or dotted in _FROM_OTHER_GROUPS):
            check_weights(dotted)
            raise unknown_setting(dotted, list(known), name)
    for k, parameter in known.items():
        if k in result or result.get("_partial_") or "_args_" in result:
            continue
        if parameter.required:
            raise _missing(f"{key}.{k}", name)
        if (name.startswith("nsm.") or k in EXTRA.get(group, ())) and _is_plain(parameter.default):
            result[k] = _listed(parameter.default)
    return result


def _missing(key: str, what: str) -> NsmError:
    message = f"setting {key}: {what} needs it; give {key}=VALUE"
    return NsmError(message, kind="missing_setting", key=key)


def takes(group: str, thing: Any) -> tuple[dict[str, Parameter], bool]:
    """The settings that a class or function takes in a group, and whether it takes any others.

    nsm's own classes name all that they take, though a base of theirs may accept others.
    """
    known, others = parameters(thing)
    if getattr(thing, "__init__", None) is torch.nn.Module.__init__:  # which takes nothing
        others = False
    others = others and not str(thing.__module__).startswith("nsm.")
    supplied = SUPPLIED.get(group, ())
    return {k: p for k, p in known.items() if k not in supplied} | EXTRA.get(group, {}), others


def _nested(key: str, value: Any) -> Any:
    """A value with the nodes in it that have a ``_target_`` checked."""
    if isinstance(value, Mapping):
        if "_target_" in value:
            return _target(key, "", value, ())
        return {k: _nested(f"{key}.{k}", v) for k, v in value.items()}
    return [_nested(key, item) for item in value] if isinstance(value, list) else value


def _fit(key: str, value: Any, parameter: Parameter) -> Any:
    try:
        return _nested(key, fit(value, parameter.kind))
    except Misfit as misfit:
        raise NsmError(f"setting {key}: {misfit}", kind=misfit.kind, key=key) from None


def _part(key: str, node: Any, known: Mapping[str, Parameter], what: str = "") -> dict[str, Any]:
    """A checked node of plain settings, with their defaults."""
    given = _mapping(key, node)
    for name in given:
        if name not in known:
            raise unknown_setting(f"{key}.{name}", list(known), what)
    result = {}
    for name, parameter in known.items():
        if name not in given and parameter.required:
            raise _missing(f"{key}.{name}", what or "the run")
        result[name] = _fit(f"{key}.{name}", given.get(name, parameter.default), parameter)
    return result


def _of_task(key: str, node: Any, kind: type | None, settings: Mapping[str, Any]) -> Any:
    """The weights or constraints of a task, which names their type; those of yours may be any."""
    name = settings["task"]["name"]
    if kind is not None:
        return _part(key, node or {}, parameters(kind)[0], f"task={name}")
    if node and settings["task"]["_target_"].startswith("nsm.pipeline."):
        raise NsmError(
            f"setting {key}: task={name} has none; omit {key}", kind="unknown_setting", key=key
        )
    return node or None


def _imported(key: str, target: str) -> Any:
    """What a target names; NsmError with the nearest name in its module."""
    try:
        thing = named_object(target)
    except NsmError as error:
        module, _, name = target.rpartition(".")
        near = difflib.get_close_matches(name, dir(sys.modules.get(module)), n=1, cutoff=0.6)
        hint = f"; did you mean {module}.{near[0]!s}?" if near else ""
        raise NsmError(f"setting {key}: {error}{hint}", kind="not_importable", key=key) from error
    if not callable(thing):
        raise NsmError(
            f"setting {key}: {target} is no class and no function", kind="wrong_type", key=key
        )
    return thing


def _mapping(key: str, node: Any) -> dict[str, Any]:
    if not isinstance(node, Mapping):
        raise NsmError(
            f"setting {key}: {node!r} is no mapping; give {key}.NAME=VALUE; see nsm --help {key}",
            kind="wrong_type",
            key=key,
        )
    return dict(node)


def _is_plain(value: Any) -> bool:
    """Whether YAML can hold a value."""
    if isinstance(value, (list, tuple)):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(map(_is_plain, value.values()))
    return value is None or isinstance(value, (bool, int, float, str))


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _check_values(key: str, value: Any) -> None:
    """NsmError for what no setting can hold.

    An interpolation that is left came out of another value, such as a file's name, and would be
    resolved when it is next looked at.
    """
    message, kind = "", "out_of_range"
    if isinstance(value, dict):
        for name, item in value.items():
            _check_values(f"{key}.{name}" if key else str(name), item)
    elif isinstance(value, list):
        for item in value:
            _check_values(key, item)
    elif isinstance(value, float) and not math.isfinite(value):
        message = f"{value} is no finite number"
    elif isinstance(value, int) and abs(value) > _LARGEST_NUMBER:
        message = f"{value} is too large a number"
    elif isinstance(value, str):
        kind = "wrong_type"
        if "${" in value:
            message = "'${' is not accepted in a value; rename the file"
        elif not value.isascii() and value != value.encode(errors="replace").decode():
            message = f"{value!r} is not UTF-8; rename the file"
    if message:
        raise NsmError(f"setting {key}: {message}", kind=kind, key=key)


def _build(settings: dict[str, Any]) -> None:
    """Make once, in small, what the settings name: the code itself knows which values it takes."""
    from nsm.maps.networks import build_network
    from nsm.tasks.optimizers import build_optimizer
    from nsm.tasks.schedules import build_scheduler

    sampler = settings["sampler"]
    if sampler.get("vertex_share", 0) + sampler.get("domain_share", 0) > 1:
        raise NsmError(
            "setting sampler.domain_share: with sampler.vertex_share it is more than 1",
            kind="out_of_range",
            key="sampler.domain_share",
        )
    max_steps = settings["trainer"]["max_steps"]
    with _same_random_numbers():
        parts = {key: settings[key] for key in ("map", "activation", "encoding")}
        with _blamed("map", parts):
            network = build_network(**parts)
        with _blamed("optimizer"):
            optimizer = build_optimizer(network, settings["optimizer"], max_steps)
        with _blamed("scheduler"):
            build_scheduler(optimizer, settings["scheduler"], max_steps)
        for key in ("domain", "energy", "sampler"):
            if settings[key]:
                with _blamed(key):
                    made(settings[key])


@contextmanager
def _same_random_numbers() -> Iterator[None]:
    """Leave the random numbers of torch, numpy and Python as they were, after errors too."""
    states = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])


@contextmanager
def _blamed(group: str, parts: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Name the group in what is said of its values; other exceptions are defects and pass.

    Args:
        group: what is made.
        parts: groups that it is made of; the one whose target refuses its values is named.
    """
    try:
        yield
    except NsmError as error:
        text = str(error)
        for name, node in (parts or {}).items():
            group = name if node["_target_"] == error.key else group
        text = text if text.startswith("setting ") else f"setting {group}: {text}"
        key = error.key if error.key and error.key.startswith(f"{group}.") else group
        raise NsmError(text, kind=error.kind, key=key) from error
    except (ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise NsmError(f"setting {group}: {reason}", kind="not_instantiable", key=group) from error
