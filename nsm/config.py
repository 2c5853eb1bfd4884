"""Compose the configuration from conf/, the plain settings and overrides."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from nsm.errors import NsmError
from nsm.migration import check_override, migrated
from nsm.settings import defaults
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
# settings that are files or folders: signs that Hydra's grammar reserves are quoted for the user
_PATHS = ("surface.path", "phi.path", "source", "target", "landmarks", "resume", "hydra.run.dir")


def conf_folder() -> Path:
    """The configuration: inside an installed package, or beside it in a clone."""
    package = Path(__file__).parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def register() -> None:
    """Make the plain settings, and the resolvers of the folders, known to Hydra.

    Mappings are open: the check knows which keys they may have, and names the nearest.
    """
    node = OmegaConf.create({**defaults(), **{key: {} for key in (*GROUPS, "logger", *_WEIGHTS)}})
    for value in node.values():
        if isinstance(value, DictConfig):
            OmegaConf.set_struct(value, False)
    ConfigStore.instance().store(name="nsm_settings", node=node, provider="nsm")
    OmegaConf.register_new_resolver("nsm.run_folder", _run_folder, replace=True, use_cache=True)
    OmegaConf.register_new_resolver("nsm.sweep_folder", _sweep_folder, replace=True)


def _task_name(task: Mapping[str, Any]) -> str:
    return str(task.get("name") or str(task.get("_target_", "task")).rpartition(".")[2].lower())


def _sweep_folder(task: Any, overrides: Sequence[str], params: Any) -> str:
    return sweep_folder(_task_name(task), overrides, params)


def _run_folder(
    resume: str | None, task: Any, surface: Any, source: Any, target: Any, surfaces: Any
) -> str:
    if resume is not None:
        return str(resume)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    what = Path(surface["path"]).stem if surface.get("path") else str(surface.get("name"))
    if surfaces is not None:
        what = "-".join(_short_name(one) for one in surfaces)
    elif target is not None:
        what = "-".join(_short_name(end) for end in (source, target))
    folder = f"outputs/{_task_name(task)}/{what[:_LONGEST_NAME]}-{stamp}"
    number, free = 2, folder
    while Path(free).exists():  # runs started within the same second
        number, free = number + 1, f"{folder}-{number}"
    return free


def _short_name(surface: Any) -> str:
    """A short name for what ``source`` or ``target`` names."""
    if isinstance(surface, (dict, DictConfig)):
        return str(surface.get("name"))
    return Path(str(surface)).stem


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
    config, _ = composed(overrides)
    if settings:
        OmegaConf.set_struct(config, False)
        config = OmegaConf.merge(config, OmegaConf.create(dict(settings)))  # type: ignore[assignment]
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


def checked(config: DictConfig, overrides: Sequence[str] = ()) -> DictConfig:
    """As :func:`nsm.config_validation.checked`, which is imported here: it needs torch."""
    from nsm.config_validation import checked

    return checked(config, overrides)


def prepared_overrides(overrides: Sequence[str]) -> list[str]:
    """Overrides with mesh files, and paths with special signs, in the form that Hydra takes.

    ``mesh.obj`` and ``surface=mesh.obj`` become ``surface.path="mesh.obj"``.

    Raises:
        NsmError: an override whose setting has another name now.
    """
    prepared = []
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals and _is_file(override):
            key, value = "surface.path", override
        check_override(key, value)
        if key == "surface" and all(map(_is_file, value.strip("'\"").split(","))):
            key = "surface.path"
        if key.lstrip("+") in _PATHS and not _readable(f"{key}={value}"):
            value = _quoted(value)
        prepared.append(f"{key}={value}" if equals or key == "surface.path" else override)
    return prepared


def _is_file(value: str) -> bool:
    from nsm.surfaces.loading import EXTENSIONS

    known = (conf_folder() / "surface" / f"{value}.yaml").is_file()
    return not known and ("/" in value or "\\" in value or Path(value).suffix.lower() in EXTENSIONS)


def _readable(override: str) -> bool:
    try:
        OverridesParser.create().parse_override(override)
    except HydraException:
        return False
    return True


def _quoted(value: str) -> str:
    escaped = re.sub(r'(\\*)"', r'\1\1\\"', value)  # a backslash before a quote or the end escapes
    return '"' + re.sub(r"(\\+)$", r"\1\1", escaped) + '"'


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
    text = str(error).strip()
    first = text.splitlines()[0] if text else type(error).__name__
    if isinstance(error, OverrideParseException):
        override = str(error.override)
        hint = "quote values with special signs, as in 'surface.path=\"a=b.obj\"'"
        if "=" not in override:
            hint = "give SETTING=VALUE; see nsm --help"
        return NsmError(
            f"{override}: not readable; {hint}", kind="unreadable_setting", key=override
        )
    several = re.search(r"Ambiguous value for argument '([^'=]+)=(.*)'$", first)
    if several:
        key, values = several.groups()
        return NsmError(
            f"{key}={values}: several values; nsm -m runs each, {key}=[{values}] is a list, "
            f"'{key}=\"{values}\"' one value with commas",
            kind="several_values",
            key=key,
        )
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        return unknown_setting(unknown.group(1))
    present = re.search(r"An item is already at '([^']+)'", text)
    if present:
        key = present.group(1)
        return NsmError(f"setting {key}: already there; omit the +", kind="already_set", key=key)
    option = re.search(r"Could not find '([^']+)/([^'/]+)'", text)
    if option:
        group, name = option.groups()
        names = re.findall(r"^\t(\S+)$", text, re.MULTILINE)
        return NsmError(
            f"{group}={name} does not exist; {nearest(name, names)}",
            kind="unknown_option",
            key=group,
        )
    key = getattr(error, "full_key", None) or None
    return NsmError(f"setting {key}: {first}" if key else first, kind="wrong_type", key=key)


def unknown_setting(key: str, known: Sequence[str] | None = None, what: str = "") -> NsmError:
    """The error for a setting that does not exist.

    Args:
        key: its dotted key.
        known: the names that its last part might have; None: those of all settings and groups.
        what: which thing has no such setting, if it belongs to one.
    """
    if known is None:
        from nsm.config_docs import known_keys

        hint = nearest(key, known_keys(), "see nsm --help")
    else:
        hint = nearest(key.rpartition(".")[2], known, "" if known else f"{what or 'it'} has none")
    message = f"{what} has no such setting" if what else "no such setting"
    return NsmError(f"setting {key}: {message}; {hint}", kind="unknown_setting", key=key)
