"""The settings of a run as people compare them: flat, with the options of groups by their names."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import yaml

from nsm.errors import NsmError
from nsm.instantiation import named_object
from nsm.settings import conf_folder, parameters

# settings that do not affect a result
_INCIDENTAL = ("resume", "logger", "artefacts", "trust", "trainer.progress")


def readable(settings: Mapping[Any, Any]) -> dict[str, Any]:
    """Settings by "group.key", and what a group chooses by "group".

    A group's choice is its option's name, where the settings are those of an option of ``conf/``;
    else its ``name``, or the name of its class. Settings that do not affect a result are left out.

    Args:
        settings: nested, as in the ``config.yaml`` of a run folder.
    """
    return dict(_flat(settings))


def _flat(settings: Mapping[Any, Any], group: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        name = f"{group}.{key}" if group else str(key)
        if name in _INCIDENTAL or (key == "_target_" and "name" in settings):
            continue
        if isinstance(value, Mapping) and value:
            yield from _flat(value, name)
        elif group and key == "_target_":
            ours = str(value).startswith(("nsm.", "torch."))
            short = str(value).rsplit(".", 1)[-1] if ours else value
            yield group, option_of(group, settings) or short
        else:
            yield (group if group and key == "name" else name), value


def option_of(group: str, settings: Mapping[Any, Any]) -> str | None:
    """The option of a group that gives settings, or None.

    Args:
        group: a folder of ``conf/``.
        settings: of the group, with ``_target_``.
    """
    target = str(settings["_target_"])
    for name, own in _options(group) if group.isidentifier() else ():
        if own["_target_"] == target:  # a class of ours: it may be imported
            full = {**_defaults(target), **own}
            given = {**_defaults(target), **settings}
            if full.keys() == given.keys() and all(full[key] == given[key] for key in full):
                return name
    return None


@functools.cache
def _options(group: str) -> list[tuple[str, dict[str, Any]]]:
    """The options of a group with ``_target_`` and settings of their own, the fullest first."""
    found = []
    for file in sorted((conf_folder() / group).glob("*.yaml")):
        own = yaml.safe_load(file.read_text(encoding="utf-8"))
        if isinstance(own, dict) and isinstance(own.get("_target_"), str):
            own.pop("defaults", None)
            found.append((file.stem, own))
    return sorted(found, key=lambda option: -len(option[1]))


@functools.cache
def _defaults(target: str) -> dict[str, Any]:
    try:
        known, _ = parameters(named_object(target))
    except NsmError:
        return {}
    defaults = {name: one.default for name, one in known.items() if not one.required}
    return {k: list(v) if isinstance(v, tuple) else v for k, v in defaults.items()}
