"""Where the configuration lies, what types it has, and how it is put together."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from nsm.errors import NsmError
from nsm.plugins import import_plugins
from nsm.sweeps import sweep_folder


@dataclass
class TaskSchema:
    name: str = MISSING


@dataclass
class PhiSchema:
    path: str | None = None
    overrides: list[str] = field(default_factory=list)


@dataclass
class SurfaceSchema:
    path: str | None = None
    name: str = MISSING
    seam_vertices: list[int] | None = None
    parameterization: str = MISSING
    cache: bool = MISSING


@dataclass
class SeamSchema:
    path: str = MISSING
    landmarks: int | None = MISSING


@dataclass
class CertificationSchema:
    repair: bool = MISSING
    rounds: int = MISSING


@dataclass
class AttributesSchema:
    source: str | None = None
    target: str | None = None


@dataclass
class MapSchema:
    width: int = MISSING
    depth: int = MISSING
    block: str = MISSING
    initialization: str = MISSING
    linear_skip: str = "none"


@dataclass
class DataSchema:
    batch_size: int = MISSING
    steps_per_epoch: int = MISSING
    vertex_share: float = MISSING
    domain_share: float = 0.0
    pool: int | None = MISSING
    held_out: int = MISSING


@dataclass
class TrainerSchema:
    max_steps: int = MISSING
    accelerator: str = MISSING
    devices: int = 1
    stop_gradient_norm: float | None = MISSING
    stop_window: int = MISSING
    threads: int | None = MISSING
    gradient_clip: float | None = MISSING
    progress: bool = MISSING
    precision: str = "float32"
    compile: bool = False


@dataclass
class LoggerSchema:
    kinds: list[str] = MISSING
    every: int = MISSING
    pictures: int = MISSING
    project: str = MISSING
    uri: str | None = MISSING


@dataclass
class Schema:
    """The whole configuration. Groups whose keys depend on the choice are free dictionaries,
    checked by what is built from them."""

    task: TaskSchema = field(default_factory=TaskSchema)
    phi: PhiSchema = field(default_factory=PhiSchema)
    surface: SurfaceSchema = field(default_factory=SurfaceSchema)
    source: Any = None
    target: Any = None
    surfaces: Any = None
    landmarks: Any = None
    attributes: AttributesSchema = field(default_factory=AttributesSchema)
    seam: SeamSchema = field(default_factory=SeamSchema)
    certification: CertificationSchema = field(default_factory=CertificationSchema)
    map: MapSchema = field(default_factory=MapSchema)
    activation: dict[str, Any] = MISSING
    encoding: dict[str, Any] = MISSING
    energy: dict[str, Any] = MISSING
    constraints: dict[str, Any] | None = None
    data: DataSchema = field(default_factory=DataSchema)
    optimizer: dict[str, Any] = MISSING
    scheduler: dict[str, Any] = MISSING
    trainer: TrainerSchema = field(default_factory=TrainerSchema)
    logger: LoggerSchema = field(default_factory=LoggerSchema)
    domain: str = MISSING
    seed: int = MISSING
    artefacts: bool = MISSING
    resume: str | None = None


# the least that each may be; those that may be null are checked where they are given
_LEAST = {
    "map.width": 1,
    "map.depth": 0,
    "data.batch_size": 1,
    "data.steps_per_epoch": 1,
    "data.pool": 1,
    "data.held_out": 1,
    "trainer.max_steps": 1,
    "trainer.devices": 1,
    "trainer.threads": 1,
    "trainer.stop_gradient_norm": 0,
    "trainer.stop_window": 1,
    "trainer.gradient_clip": 0,
    "certification.rounds": 0,
    "logger.every": 1,
    "logger.pictures": 0,
    "seed": 0,
}
_LARGEST_SEED = 2**32 - 1  # that numpy takes
_LARGEST_NUMBER = 2**63 - 1  # that whole numbers of 64 bits hold


_LARGEST_CONFIG = 1_000_000  # bytes
_LONGEST_NAME = 100  # of a run folder, without its time; file systems take 255 bytes

# of matrix products in a training, in torch's words
PRECISIONS = {"float32": "highest", "tf32": "high", "bf16": "medium"}


def conf_folder() -> Path:
    """The configuration: inside an installed package, or beside it in a clone."""
    package = Path(__file__).parent
    installed = package / "conf"
    return installed if installed.is_dir() else package.parent / "conf"


def register_resolvers() -> None:
    """Make ``nsm.run_folder`` and ``nsm.sweep_folder`` known to the configuration files."""
    OmegaConf.register_new_resolver("nsm.run_folder", _run_folder, replace=True, use_cache=True)
    OmegaConf.register_new_resolver("nsm.sweep_folder", sweep_folder, replace=True)


def _run_folder(
    resume: str | None,
    task: str,
    name: str,
    path: str | None,
    source: Any,
    target: Any,
    surfaces: Any,
) -> str:
    if resume is not None:
        return str(resume)
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    what = Path(path).stem if path else name
    if surfaces is not None:
        what = "-".join(_called(surface) for surface in surfaces)
    elif target is not None:
        what = "-".join(_called(end) for end in (source, target))
    folder = f"outputs/{task}/{what[:_LONGEST_NAME]}-{stamp}"
    number, free = 2, folder
    while Path(free).exists():  # runs started within the same second
        number, free = number + 1, f"{folder}-{number}"
    return free


def _called(surface: Any) -> str:
    """A short name for what ``source`` or ``target`` names."""
    if isinstance(surface, (dict, DictConfig)):
        return str(surface.get("name"))
    return Path(str(surface)).stem


def compose_config(overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration with overrides as on the command line, checked.

    Raises:
        NsmError: an override that names no key or has the wrong type.
    """
    register_resolvers()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(conf_folder()), version_base="1.3"):
            return checked(compose("config", overrides=list(overrides)))
    except (HydraException, OmegaConfBaseException) as error:
        raise NsmError(one_line(error, overrides)) from error


def checked(config: DictConfig) -> DictConfig:
    """The configuration with the types of :class:`Schema`, resolved.

    Raises:
        NsmError: a key that does not exist, a value of the wrong type or out of range.
    """
    import_plugins()  # the jobs of a sweep may run in processes of their own
    try:
        typed = OmegaConf.merge(OmegaConf.structured(Schema), config)
        OmegaConf.resolve(typed)
    except OmegaConfBaseException as error:
        raise NsmError(_misfit(error)) from error
    assert isinstance(typed, DictConfig)
    _check_values("", OmegaConf.to_container(typed, resolve=False))
    missing = sorted(OmegaConf.missing_keys(typed))
    if missing:
        raise NsmError(f"setting {missing[0]}: missing; choose an option of its group or give it")
    for key, least in _LEAST.items():
        value = OmegaConf.select(typed, key)
        if value is not None and value < least:
            raise NsmError(f"setting {key}: {value} is not at least {least}")
    if typed.seed > _LARGEST_SEED:
        raise NsmError(f"setting seed: {typed.seed} is more than {_LARGEST_SEED}")
    if typed.trainer.precision not in PRECISIONS:
        words = ", ".join(PRECISIONS)
        raise NsmError(f"setting trainer.precision: {typed.trainer.precision} is not of {words}")
    for key in ("vertex_share", "domain_share"):
        if not 0 <= typed.data[key] <= 1:
            raise NsmError(f"setting data.{key}: {typed.data[key]} is not in [0, 1]")
    if typed.data.vertex_share + typed.data.domain_share > 1:
        raise NsmError("setting data.domain_share: with data.vertex_share it is more than 1")
    from nsm.config_validation import (
        check_choices,  # torch takes seconds; mistakes above need not wait
    )

    check_choices(typed)
    if typed.phi.overrides:
        compose_config(["task=overfit", *typed.phi.overrides])
    return typed


def read_config(file: Path) -> DictConfig:
    """A configuration that a run has stored.

    It may come from a stranger: what a stored one never holds, because it is resolved, is refused
    before it could be carried out: interpolations, which read the environment, tags, which name
    Python objects, and aliases, which may repeat each other without end.

    Raises:
        NsmError: a file that cannot be read, or that holds such things.
    """
    try:
        if file.stat().st_size > _LARGEST_CONFIG:
            raise ValueError(f"larger than {_LARGEST_CONFIG} bytes")
        text = file.read_text(encoding="utf-8")
        before: yaml.Event | None = None
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                raise ValueError("anchors are not taken")
            if isinstance(event, yaml.ScalarEvent) and isinstance(before, yaml.DocumentStartEvent):
                raise ValueError("a lone word")  # OmegaConf would fail on some of them
            before = event
            if getattr(event, "tag", None):
                raise ValueError("tags are not taken")
            if isinstance(event, yaml.ScalarEvent) and "${" in event.value:
                raise ValueError("interpolations are not taken")
        stored = OmegaConf.create(text)
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException, RecursionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise NsmError(f"{file}: not a configuration ({reason}); start the run again") from error
    if not isinstance(stored, DictConfig):
        raise NsmError(f"{file}: not a configuration; start the run again")
    return stored


def _check_values(key: str, value: Any) -> None:
    """NsmError for what a value must not hold once it is resolved.

    An interpolation that is left came out of another value, such as a file's name, and would be
    resolved when it is next looked at. Nothing is made by ``_target_``: registries name what is.
    """
    if isinstance(value, dict):
        for name, item in value.items():
            if name == "_target_":
                raise NsmError(
                    f"setting {key or name}: '_target_' is not taken; things are made by the names "
                    "that nsm --help lists, and by those that modules in NSM_PLUGINS register"
                )
            _check_values(f"{key}.{name}" if key else str(name), item)
    elif isinstance(value, list):
        for item in value:
            _check_values(key, item)
    elif isinstance(value, float) and not math.isfinite(value):
        raise NsmError(f"setting {key}: {value} is no finite number")
    elif isinstance(value, int) and abs(value) > _LARGEST_NUMBER:
        raise NsmError(f"setting {key}: {value} is too large a number")
    elif isinstance(value, str):
        if "${" in value:
            raise NsmError(f"setting {key}: '${{' is not taken in a value; rename the file")
        try:
            value.encode()
        except UnicodeEncodeError:
            raise NsmError(f"setting {key}: {value!r} is not UTF-8; rename the file") from None


def _misfit(error: OmegaConfBaseException) -> str:
    """What does not fit the types, with the nearest name for a key that does not exist."""
    key = getattr(error, "full_key", None) or ""
    if not isinstance(error, ConfigKeyError):
        return f"setting {key}: {one_line(error)}"
    near = difflib.get_close_matches(key, known_keys(), n=1, cutoff=0.6)
    hint = f"did you mean '{near[0]}'?" if near else "see nsm --help"
    return f"setting {key}: no setting is called so; {hint}"


def one_line(error: BaseException, overrides: Sequence[str] = ()) -> str:
    """An error of the configuration libraries in one line, with the nearest valid name.

    Args:
        error: what was raised.
        overrides: that it was raised for; with them the chosen options are known, and so is what
            they take.
    """
    text = str(error).strip()
    first = text.splitlines()[0] if text else type(error).__name__
    if isinstance(error, OverrideParseException):
        if "=" not in str(error.override):
            from nsm.surfaces.loading import EXTENSIONS

            mesh = Path(str(error.override)).suffix.lower() in EXTENSIONS
            hint = f"surface.path={error.override}" if mesh else "SETTING=VALUE; see nsm --help"
            return f"{error.override}: no setting, and no command of nsm; give {hint}"
        return (
            f"{error.override}: cannot be read; quote values with signs in them, as in "
            "'surface.path=\"a=b.obj\"'"
        )
    several = re.search(r"Ambiguous value for argument '([^'=]+)=(.*)'$", first)
    if several:
        key, values = several.groups()
        return (
            f"{key}={values}: several values; nsm -m runs each, {key}=[{values}] is a list, "
            f"'{key}=\"{values}\"' one value with commas"
        )
    unknown = re.search(r"Could not override '([^']+)'", text)
    if unknown:
        return _unknown(unknown.group(1), overrides)
    twice = re.search(r"Could not append to config. An item is already at '([^']+)'", text)
    if twice:
        return f"setting {twice.group(1)}: it is there already; leave out the +"
    option = re.search(r"Could not find '([^']+)/([^'/]+)'", text)
    if option:
        group, name = option.groups()
        names = sorted(p.stem for p in (conf_folder() / group).glob("*.yaml"))
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
        hint = f"did you mean '{near[0]}'?" if near else f"choose one of {', '.join(names)}"
        return f"{group}={name} does not exist; {hint}"
    return first


def _single(overrides: Sequence[str]) -> list[str]:
    """The overrides of one job of a sweep."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return [
        f"{word.get_key_element()}={next(word.sweep_string_iterator())}"
        if word.is_discrete_sweep()
        else str(word.input_line)
        for word in parsed
        if not word.is_interval_sweep()
    ]


def _unknown(key: str, overrides: Sequence[str]) -> str:
    """What to say of an override whose key the configuration does not have."""
    overrides = _single(overrides)
    given = [word for word in overrides if word.startswith(f"{key}=")]
    if given and "." in key:
        # taken as an addition it is checked against what the chosen options take
        try:
            compose_config([f"+{word}" if word in given else word for word in overrides])
        except NsmError as error:
            return str(error)
        else:
            return f"setting {key}: the chosen option leaves it out; add it with +{given[0]}"
    near = difflib.get_close_matches(key, known_keys(), n=1, cutoff=0.6)
    hint = f"did you mean '{near[0]}'?" if near else "see nsm --help"
    return f"no setting or group is called '{key}'; {hint}"


def known_keys() -> list[str]:
    """Names of all groups and settings, dotted."""
    from nsm.config_docs import groups, ungrouped

    known = {setting.key for setting in ungrouped()}
    for group in groups():
        known.add(group.name.replace("/", "."))
        known.update(setting.key for option in group.options for setting in option.settings)
    return sorted(known)
