"""Compose the configuration from conf/, the plain settings and overrides."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from nsm.command_line import prepared_overrides
from nsm.errors import NsmError
from nsm.migration import migrated
from nsm.settings import Settings, conf_folder
from nsm.sweeps import sweep_folder

# groups of which an option is one ``_target_``, and those that hold several of them by name
GROUPS = (
    "task", "domain", "map", "activation", "encoding", "energy", "sampler", "data", "optimizer",
    "scheduler",
)  # fmt: skip
COLLECTIONS = ("logger", "callbacks", "loss_terms")
_WEIGHTS = ("loss_weights", "constraints")

_LARGEST_CONFIG = 1_000_000  # bytes
_LONGEST_NAME = 100  # of a run folder, without its time; file systems take 255 bytes


def register() -> None:
    """Make the plain settings, and the resolvers of the folders, known to Hydra.

    Mappings are open: the check knows which keys they may have, and names the nearest.
    """
    groups: dict[str, Any] = dict.fromkeys((*GROUPS, "logger", *_WEIGHTS), {})
    node = OmegaConf.create({**asdict(Settings()), **groups})
    for value in node.values():
        if isinstance(value, DictConfig):
            OmegaConf.set_struct(value, False)
    ConfigStore.instance().store(name="nsm_settings", node=node, provider="nsm")
    OmegaConf.register_new_resolver("nsm.run_folder", _run_folder, replace=True, use_cache=True)
    OmegaConf.register_new_resolver(
        "nsm.sweep_folder",
        lambda task, overrides: sweep_folder(_task_name(task), overrides),
        replace=True,
    )


def _task_name(task: Mapping[str, Any]) -> str:
    return str(task.get("name") or str(task.get("_target_", "task")).rpartition(".")[2].lower())


def _run_folder(
    resume: str | None, task: Any, surface: Any, source: Any, target: Any, surfaces: Any
) -> str:
    if resume is not None:
        return str(resume)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    ends = (surface,) if target is None else (source, target)
    if surfaces is not None:
        ends = (surfaces,) if isinstance(surfaces, str) else tuple(surfaces)
    what = "-".join(map(_short_name, ends))
    folder = f"outputs/{_task_name(task)}/{what[:_LONGEST_NAME]}-{stamp}"
    number, free = 2, folder
    while Path(free).exists():  # runs started within the same second
        number, free = number + 1, f"{folder}-{number}"
    return free


def _short_name(surface: Any) -> str:
    """A short name for what ``surface``, ``source`` or ``target`` names."""
    if isinstance(surface, (dict, DictConfig)):
        return Path(surface["path"]).stem if surface.get("path") else str(surface.get("name"))
    path = Path(str(surface))
    return path.parent.name if "*" in path.name else path.stem  # of all scans in a folder


def compose_config(
    overrides: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
) -> DictConfig:
    """The configuration with overrides as on the command line, checked and completed.

    Hydra's state in the caller's process is left as it was.

    Args:
        overrides: such as ``["activation=silu", "trainer.max_steps=500"]``.
        settings: further settings as nested dictionaries, which are merged in last.

    Raises:
        NsmError: a setting that does not exist, or a value that does not fit.
    """
    from nsm.config_validation import checked  # which imports torch

    overrides = prepared_overrides(overrides)
    config, _ = composed(overrides)
    if settings:
        OmegaConf.set_struct(config, False)
        config = OmegaConf.merge(config, dict(settings))  # type: ignore[assignment]
    return checked(config, [*overrides, *dotted(settings or {})])


def composed(overrides: Sequence[str] = ()) -> tuple[DictConfig, dict[str, str | None]]:
    """The configuration as Hydra composes it, not checked, and the option chosen in each group.

    Raises:
        NsmError: a group, an option or an override that does not exist.
    """
    register()
    prepared = prepared_overrides(overrides)
    try:
        with _own_hydra(), initialize_config_dir(str(conf_folder()), version_base="1.3"):
            config = compose("config", overrides=prepared, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise setting_error(error) from error
    choices = dict(config.hydra.runtime.choices)
    with open_dict(config):
        del config["hydra"]
    return config, choices


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Hydra as if nobody else used it; the caller's is put back."""
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        GlobalHydra.instance().hydra = before


def dotted(settings: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Nested settings as on a command line: each as KEY=VALUE."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}={value}"


def read_config(file: Path) -> DictConfig:
    """A configuration that a run has stored, with the names that settings have now.

    It may come from a stranger: what a stored one never holds, because it is resolved, is refused
    before it could act: interpolations, which read the environment, tags, which name Python
    objects, and aliases, which may repeat each other without end. Its ``_target_``s must still be
    checked (:func:`nsm.instantiation.check_trusted`).

    Raises:
        NsmError: a file that cannot be read, or that holds such things.
    """
    try:
        if file.stat().st_size > _LARGEST_CONFIG:
            raise ValueError(f"larger than {_LARGEST_CONFIG} bytes")
        text = file.read_text(encoding="utf-8")
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                raise ValueError("anchors are not accepted")
            if getattr(event, "tag", None):
                raise ValueError("tags are not accepted")
            if isinstance(event, yaml.ScalarEvent) and "${" in event.value:
                raise ValueError("interpolations are not accepted")
        stored = yaml.safe_load(text)
        if not isinstance(stored, dict):
            raise ValueError("no mapping")
        return OmegaConf.create(migrated(OmegaConf.to_container(OmegaConf.create(text))))
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException, RecursionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise NsmError(
            f"{file}: not a configuration ({reason}); start the run again",
            kind="damaged_file",
            key=str(file),
        ) from error


def nearest(name: str, known: Sequence[str], otherwise: str = "") -> str:
    """A hint for a name that is not known: the nearest one, or all, or what to do otherwise."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"did you mean {near[0]!r}?"
    return otherwise or (f"choose one of {', '.join(known)}" if known else "there are none")


def setting_error(error: Exception) -> NsmError:
    """What Hydra or OmegaConf say of a setting, as an error in one line with the nearest name."""
    text = str(error).strip() or type(error).__name__
    first = text.splitlines()[0]
    if isinstance(error, OverrideParseException):
        key = str(error.override)
        hint = "quote values with special signs, as in 'surface.path=\"a=b.obj\"'"
        if "=" not in key:
            hint = "give SETTING=VALUE; see nsm --help"
        return NsmError(f"{key}: not readable; {hint}", kind="unreadable_setting", key=key)
    if found := re.search(r"Ambiguous value for argument '([^'=]+)=(.*)'$", first):
        key, values = found.groups()
        return NsmError(
            f"{key}={values}: several values; nsm -m runs each, {key}=[{values}] is a list, "
            f"'{key}=\"{values}\"' one value with commas",
            kind="several_values",
            key=key,
        )
    if found := re.search(r"Could not override '([^']+)'", text):
        return unknown_setting(found[1])
    if found := re.search(r"An item is already at '([^']+)'", text):
        message = f"setting {found[1]}: already there; omit the +"
        return NsmError(message, kind="already_set", key=found[1])
    if found := re.search(r"Could not find '([^']+)/([^'/]+)'", text):
        group, name = found.groups()
        # an experiment that chooses options by the task, for one that has none of them
        for task in (path.stem for path in (conf_folder() / "task").glob("*.yaml")):
            if name.endswith(f"_{task}"):
                message = (
                    f"the experiment has no {group} for task={task}; see nsm --help experiment"
                )
                return NsmError(message, kind="unknown_option", key="experiment")
        hint = nearest(name, re.findall(r"^\t(\S+)$", text, re.MULTILINE))
        message = f"{group}={name} does not exist; {hint}"
        return NsmError(message, kind="unknown_option", key=group)
    setting = getattr(error, "full_key", None) or None
    message = f"setting {setting}: {first}" if setting else first
    return NsmError(message, kind="wrong_type", key=setting)


def unknown_setting(key: str, known: Sequence[str] | None = None, what: str = "") -> NsmError:
    """The error for a setting that does not exist.

    Args:
        key: its dotted key.
        known: the names that its last part might have; None: those of all settings and groups.
        what: which thing has no such setting, if it belongs to one.
    """
    if known is None:
        from nsm.help import known_keys

        last = key.rpartition(".")[2]
        same = [one for one in known_keys() if "." in one and one.rpartition(".")[2] == last]
        # a name that one group alone has: the group is what is wrong
        hint = nearest(key, known_keys(), "see nsm --help")
        if "." in key and len(same) == 1:
            hint = f"did you mean {same[0]!r}?"
    else:
        hint = nearest(key.rpartition(".")[2], known, "" if known else f"{what or 'it'} has none")
    message = f"{what} has no such setting" if what else "no such setting"
    return NsmError(f"setting {key}: {message}; {hint}", kind="unknown_setting", key=key)
