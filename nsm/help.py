"""``nsm --help``: the groups with their options; ``nsm --help NAME``: one, or a setting."""

from __future__ import annotations

import difflib
from dataclasses import replace

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from nsm.config import known_keys
from nsm.config_docs import Group, Setting, groups, ungrouped
from nsm.errors import NsmError

_USAGE = """\
Neural surface maps: meshes as networks, and maps between them.

  nsm [GROUP=OPTION ...] [SETTING=VALUE ...]     run
  nsm -m GROUP=OPTION,OPTION ...                 run all combinations: a sweep
  nsm -m sweep=NAME ...                          a sweep that is ready
  nsm resume=FOLDER                              go on with an interrupted run
  nsm report FOLDER...                           compare runs in one page
  nsm view FOLDER                                a run's shapes in the browser
  nsm --help NAME                                on a group or a setting
  nsm --cfg job [...]                            the settings, and no run"""

_CLOSING = """\
Any setting can be replaced: trainer.max_steps=500, energy.lambda_normal=0.1; one that the chosen \
option lacks is added with a plus: +optimizer.weight_decay=1e-4. Bad input is told in one line, \
with exit status 2. Completion: eval "$(nsm -sc install=bash)" (zsh: bash's with bashcompinit; \
fish: nsm -sc install=fish | source). Hydra's own flags: --hydra-help."""


def main(words: list[str]) -> None:
    """Print the help on the groups and settings that words name, or on all groups in short.

    Raises:
        NsmError: a word that names neither a group nor a setting.
    """
    console = Console(highlight=False, soft_wrap=False)
    known = {group.name: group for group in groups()}
    for name in [word.split("=")[0] for word in words]:
        if name in known:
            _one(console, known[name])
        elif not _explained(console, name):
            near = difflib.get_close_matches(name, [*known, *known_keys()], n=1, cutoff=0.4)
            hint = f"did you mean '{near[0]}'?" if near else f"groups: {', '.join(known)}"
            raise NsmError(f"--help {name}: no group or setting is called so; {hint}")
    if words:
        return
    console.print(_USAGE)
    console.print("\n[bold]Groups[/bold] and their options, * taken by default\n")
    for group in known.values():
        _short(console, group)
    console.print("[bold]Settings[/bold] outside the groups\n")
    _settings(console, ungrouped())
    console.print()
    console.print(_CLOSING)


def _explained(console: Console, name: str) -> bool:
    """Print a setting, or those under a name, wherever it stands; False if there is none."""

    def named(settings: tuple[Setting, ...]) -> tuple[Setting, ...]:
        return tuple(s for s in settings if s.key == name or s.key.startswith(f"{name}."))

    outside = named(ungrouped())
    if outside:
        _settings(console, outside)
        console.print()
    found = bool(outside)
    for group in groups():
        options = [replace(option, settings=named(option.settings)) for option in group.options]
        chosen = tuple(option for option in options if option.settings)
        if chosen:
            found = True
            _one(console, replace(group, options=chosen))
    return found


def _short(console: Console, group: Group) -> None:
    console.print(Text.assemble((group.name, "bold cyan"), f"  {group.remark}"))
    console.print(_options(group))
    console.print()


def _one(console: Console, group: Group) -> None:
    console.print(Text.assemble((group.name, "bold cyan"), f"  {group.remark}\n"))
    for option in group.options:
        star = "*" if option.name == group.default else " "
        console.print(Text.assemble(f"{star} {group.name}=", (option.name, "bold")))
        console.print(Padding(Text(option.remark), (0, 0, 0, 4)))
        if option.settings:
            _settings(console, option.settings)
        console.print()


def _options(group: Group) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=24, no_wrap=True)
    table.add_column(overflow="fold")
    for option in group.options:
        star = "*" if option.name == group.default else " "
        table.add_row(Text(f"  {star} {option.name}"), Text(option.remark))
    return table


def _settings(console: Console, settings: tuple[Setting, ...]) -> None:
    names = [f"    {setting.key}={setting.value}" for setting in settings]
    room = console.width * 3 // 5
    column = max([24, *(len(name) for name in names if len(name) <= room)])
    for name, setting in zip(names, settings, strict=True):
        if len(name) > room:  # a line of its own: folded, it could not be copied
            console.print(Text(name), soft_wrap=True)
            name = ""
        table = Table.grid(padding=(0, 2))
        table.add_column(width=column)
        table.add_column()
        table.add_row(Text(name), Text(setting.remark))
        console.print(table)
