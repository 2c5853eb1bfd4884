"""``nsm --help``: the groups with their options; ``nsm --help NAME``: one, or a setting."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from nsm.config import composed, nearest
from nsm.config_docs import Group, Setting, groups, known_keys, option_settings, plain_settings
from nsm.errors import NsmError

Choices = dict[str, str | None]  # option by group

# groups whose options set the settings of others
_OVER_OTHERS = ("task", "initialization", "experiment")

_USAGE = """\
Neural surface maps: meshes as networks, and maps between them.

  nsm MESH [GROUP=OPTION ...] [SETTING=VALUE ...]   run
  nsm -m GROUP=OPTION,OPTION ...                 run all combinations: a sweep
  nsm -m sweep=NAME ...                          one of the sweeps below
  nsm resume=FOLDER                              continue an interrupted run
  nsm report FOLDER...                           compare runs on one page
  nsm view FOLDER                                show a run's shapes in the browser
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
