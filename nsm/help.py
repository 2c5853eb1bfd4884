"""The groups, options and settings with a remark on each: for ``nsm --help`` and the docs.

Groups and options come from the comments in conf/; settings from the signatures and docstrings of
what an option's ``_target_`` names, and from :mod:`nsm.settings`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import docstring_parser
import yaml
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from nsm import settings as plain
from nsm.config import COLLECTIONS, composed, conf_folder, nearest
from nsm.errors import NsmError

_PACKAGE = re.compile(r"#\s*@package\s+(\S+)")
_DEFAULT = re.compile(r"  - (?:override )?([^\s:]+): (\S+)$")
# whose docstrings say what the settings of these groups are
_DATACLASSES: dict[str, tuple[type, ...]] = {
    "loss_weights": (plain.OverfitWeights, plain.ParamWeights, plain.PairWeights),
    "constraints": (
        plain.ParamConstraints,
        plain.PairConstraints,
        plain.CollectionConstraints,
    ),
}


@dataclass(frozen=True)
class Setting:
    """A setting: its dotted key, its value as YAML, and what it is."""

    key: str
    value: str
    remark: str


@dataclass(frozen=True)
class Group:
    """A choice: its options with a remark on each, and the default (``null``: none)."""

    name: str
    remark: str
    default: str
    options: dict[str, str]


def groups(own: Path | None = None) -> list[Group]:
    """All groups in the order of the defaults list, but for the task, which comes first.

    Args:
        own: the user's folder, with options beside those of nsm.
    """
    folders = [conf_folder(), *([own] if own else [])]
    found, remark = [], []
    for line in (conf_folder() / "config.yaml").read_text(encoding="utf-8").splitlines():
        entry = _DEFAULT.match(line)
        if line.startswith("  #"):
            remark.append(line.strip(" #"))
        elif entry:
            if remark:  # the others are Hydra's, and no choice of ours
                name, default = entry.groups()
                files = sorted(
                    file for folder in folders for file in (folder / name).glob("*.yaml")
                )
                options = {file.stem: _first_comment(file) for file in files}
                found.append(Group(name, " ".join(remark), default, options))
            remark = []
    return sorted(found, key=lambda group: group.name != "task")


def _first_comment(file: Path) -> str:
    lines = file.read_text(encoding="utf-8").splitlines()
    comments = [line for line in lines if line.startswith("#") and not _PACKAGE.match(line)]
    return comments[0].strip("# ") if comments else ""


def option_settings(
    group: str, name: str, run: Mapping[str, Any] | None = None, own: Path | None = None
) -> list[Setting]:
    """The settings of an option, with their values.

    Args:
        group, name: of the option.
        run: the configuration of a run that has chosen it, whose values are shown then.
        own: the user's folder of options; nsm's take precedence, as in a run.
    """
    file = conf_folder() / group / f"{name}.yaml"
    if own and not file.is_file():
        file = own / group / f"{name}.yaml"
    text = file.read_text(encoding="utf-8")
    package = _PACKAGE.match(text)
    node: Any = OmegaConf.to_container(OmegaConf.create(text))
    node.pop("defaults", None)
    if package:  # settings of other groups: those of the file alone
        return [_setting(k, v) for k, v in _leaves(node) if k not in ("hydra.mode", "task.name")]
    key = group.replace("/", ".")
    if run is not None and not group.startswith("hydra/"):
        node = run.get(key) or node
    if group in COLLECTIONS:
        return [s for k, part in node.items() for s in target_settings(f"{key}.{k}", group, part)]
    if "_target_" in node:
        return target_settings(key, group, node)
    for kind in _DATACLASSES.get(group, ()):
        known = plain.parameters(kind)[0]
        if {k for k, p in known.items() if p.required} <= set(node) <= set(known):
            node = {k: node.get(k, p.default) for k, p in known.items()}
    return [_setting(f"{key}.{k}", value) for k, value in node.items()]


def target_settings(key: str, group: str, node: Mapping[str, Any]) -> list[Setting]:
    """The settings of a node with ``_target_``: all parameters that its signature has."""
    # torch takes seconds; the overview of the help need not wait
    from nsm.config_validation import takes
    from nsm.instantiation import named_object

    thing = named_object(str(node["_target_"]))
    said = remarks(thing)
    return [
        Setting(f"{key}.{k}", _yaml(node.get(k, p.default)), p.remark or said.get(k, ""))
        for k, p in takes(group, thing)[0].items()
        if k != "name" or group != "task"
    ]


def plain_settings(run: Mapping[str, Any]) -> list[Setting]:
    """The settings outside the groups, with their values in a configuration."""
    run = OmegaConf.to_container(run) if isinstance(run, DictConfig) else run  # type: ignore[assignment]
    nested = {key: run[key] for key in plain.parts()}
    others = {key: run[key] for key in plain.parameters(plain.Settings)[0] if key not in nested}
    return [_setting(key, value) for key, value in _leaves({**nested, **others})]


def known_keys() -> list[str]:
    """Names of all groups and plain settings, dotted."""
    keys = {group.name.replace("/", ".") for group in groups()}
    return sorted(keys | set(plain.parts()) | set(_plain_remarks()))


def _setting(key: str, value: Any) -> Setting:
    if key.startswith("hydra.sweeper.params."):
        return Setting(key, _yaml(value), "the values of the sweep")
    remark = _plain_remarks().get(key)
    if not remark:
        group, _, name = key.partition(".")
        remark = _option_remarks(group).get(name, "")
    return Setting(key, _yaml(value), remark)


@cache
def _option_remarks(group: str) -> dict[str, str]:
    """What the classes of a group's options say of its settings, the default's first."""
    from nsm.instantiation import named_object

    files = sorted((conf_folder() / group).glob("*.yaml"))
    options: list[Any] = [OmegaConf.create(file.read_text(encoding="utf-8")) for file in files]
    found: dict[str, str] = {}
    for node in (composed()[0].get(group) or {}, *options):
        said = remarks(named_object(node["_target_"])) if "_target_" in node else {}
        found = said | found
    return found


@cache
def _plain_remarks() -> dict[str, str]:
    found = dict(remarks(plain.Settings))
    nested = {key: (kind,) for key, kind in plain.parts().items()}
    for key, kinds in {**nested, **_DATACLASSES}.items():
        for kind in kinds:
            found |= {f"{key}.{name}": text for name, text in remarks(kind).items()}
    return found


def remarks(thing: Callable[..., Any]) -> dict[str, str]:
    """What the docstring of a class or function says of its parameters, in a line each."""
    found: dict[str, str] = {}
    for text in (getattr(thing, "__doc__", None), getattr(thing.__init__, "__doc__", None)):  # type: ignore[misc]
        for parameter in docstring_parser.parse(text or "").params:
            line = " ".join((parameter.description or "").split())
            line = re.sub(r":\w+:`~?([^`]*)`", r"`\1`", line).replace("``", "`")
            line = re.sub(r" \(default: .*\)$", "", line)  # the value stands beside it
            for name in parameter.arg_name.split(","):
                found.setdefault(name.strip("* "), line.rstrip("."))
    return found


def _leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{key}.")
        elif key != "_target_":
            yield f"{prefix}{key}", value


def _yaml(value: Any) -> str:
    if value is inspect.Parameter.empty:
        return "???"  # as Hydra writes what must be given
    if isinstance(value, tuple):
        value = list(value)
    try:
        text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True)
    except yaml.YAMLError:  # a default that only Python can write down
        return "..."
    return text.removesuffix("...\n").strip()


Choices = dict[str, str | None]  # option by group

# groups whose options set the settings of others
_OVER_OTHERS = ("task", "initialization", "experiment")

_USAGE = """\
Neural surface maps: meshes as networks, and maps between them.

  nsm MESH [GROUP=OPTION ...] [SETTING=VALUE ...]   run
  nsm pair_map MESH MESH [landmarks=FILE] ...    the same for two surfaces, or for another task
  nsm ... device=cuda                            on the GPU, or device=cpu
  nsm -m GROUP=OPTION,OPTION ...                 run all combinations: a sweep
  nsm -m sweep=NAME ...                          one of the sweeps below
  nsm resume=FOLDER                              continue an interrupted run
  nsm report FOLDER...                           compare runs on one page
  nsm view FOLDER                                show a run's shapes in the browser
  nsm landmarks MESH MESH...                     place landmarks in the browser
  nsm --help NAME [...]                          about a group or a setting
  nsm --cfg job [...]                            print the settings, without a run
  nsm --debug [...]                              with tracebacks of errors"""

_CLOSING = """\
SETTING=VALUE sets any of these, and any parameter of a chosen option: trainer.max_steps=500, \
optimizer.weight_decay=1e-4. GROUP._target_=MODULE.CLASS uses a class of yours. Bad input is \
answered in one line, with exit status 2. Completion: eval "$(nsm -sc install=bash)" (zsh: with \
bashcompinit; fish: nsm -sc install=fish | source). Hydra's own flags: --hydra-help."""


def main(arguments: list[str], own: Path | None = None) -> None:
    """Print the help on the groups and settings that arguments name, or on all groups in short.

    Args:
        arguments: names; and overrides, which change the values that are shown. Without a name,
            the settings that the overrides set are the names.
        own: the user's folder of options, beside those of nsm.

    Raises:
        NsmError: a name of neither a group nor a setting.
    """
    overrides = [argument for argument in arguments if "=" in argument]
    names = [argument for argument in arguments if "=" not in argument]
    names = names or [override.partition("=")[0].lstrip("+~") for override in overrides]
    search = [f"hydra.searchpath=['file://{own.absolute()}']"] if own else []
    config, chosen = composed([*search, *overrides])
    run: Any = OmegaConf.to_container(config)
    console = Console(highlight=False, soft_wrap=False)
    for name in names:
        if not _explained(console, name, run, chosen, own):
            hint = nearest(name, known_keys(), "see nsm --help")
            message = f"--help {name}: no such group or setting; {hint}"
            raise NsmError(message, kind="unknown_setting", key=name)
    if names:
        return
    console.print(_USAGE)
    console.print("\n[bold]Groups[/bold] and their options, * by default\n")
    for group in groups(own):
        _heading(console, group)
        console.print(_options(group, chosen))
        console.print()
    console.print("[bold]Settings[/bold] outside the groups\n")
    _settings(console, plain_settings(run))
    console.print()
    console.print(_CLOSING)


def _explained(
    console: Console, name: str, run: dict[str, Any], chosen: Choices, own: Path | None
) -> bool:
    """Print a group, a setting or the settings below a name; False if there is none."""

    def named(settings: list[Setting]) -> list[Setting]:
        return [s for s in settings if s.key == name or s.key.startswith(f"{name}.")]

    outside = named(plain_settings(run))
    if outside:
        _settings(console, outside)
        console.print()
    found = bool(outside)
    for group in groups(own):
        key = group.name.replace("/", ".")
        whole = name in (group.name, key)
        if not whole and not name.startswith(f"{key}.") and group.name not in _OVER_OTHERS:
            continue
        if whole:
            found = True
            _heading(console, group)
            console.print()
        for option in group.options:
            is_chosen = chosen.get(group.name) == option
            settings = option_settings(group.name, option, run if is_chosen else None, own)
            shown = settings if whole else named(settings)
            if whole or shown:
                found = True
                _one(console, group, option, is_chosen, shown)
    return found


def _heading(console: Console, group: Group) -> None:
    console.print(Text.assemble((group.name, "bold cyan"), f"  {group.remark}"))


def _one(
    console: Console, group: Group, option: str, is_chosen: bool, settings: list[Setting]
) -> None:
    console.print(Text.assemble(f"{'*' if is_chosen else ' '} {group.name}=", (option, "bold")))
    console.print(Padding(Text(group.options[option]), (0, 0, 0, 4)))
    if settings:
        _settings(console, settings)
    console.print()


def _options(group: Group, chosen: Choices) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=24, no_wrap=True)
    table.add_column(overflow="fold")
    for option, remark in group.options.items():
        star = "*" if chosen.get(group.name) == option else " "
        table.add_row(Text(f"  {star} {option}"), Text(remark))
    return table


def _settings(console: Console, settings: list[Setting]) -> None:
    names = [f"    {setting.key}={setting.value}" for setting in settings]
    room = console.width * 3 // 5
    column = max([24, *(len(name) for name in names if len(name) <= room)])
    for name, setting in zip(names, settings, strict=True):
        if len(name) > room:  # on its own line: folded, it could not be copied
            console.print(Text(name), soft_wrap=True)
            name = ""
        table = Table.grid(padding=(0, 2))
        table.add_column(width=column)
        table.add_column()
        table.add_row(Text(name), Text(setting.remark))
        console.print(table)
