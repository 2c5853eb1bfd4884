"""``nsm --help``: the groups with their options; ``nsm --help GROUP``: the settings of one."""

from __future__ import annotations

import difflib

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from nsm.errors import NsmError
from nsm.reference import Group, Setting, groups, ungrouped

_USAGE = """\
Neural surface maps: meshes as networks, and maps between them.

  nsm [GROUP=OPTION ...] [SETTING=VALUE ...]     run
  nsm -m GROUP=OPTION,OPTION ...                 run all combinations: a sweep
  nsm -m sweep=NAME ...                          a sweep that is ready
  nsm resume=FOLDER                              go on with an interrupted run
  nsm report FOLDER...                           compare runs in one page
  nsm view FOLDER                                a run's shapes in the browser
  nsm --help GROUP                               the settings of a group
  nsm --cfg job [...]                            the settings, and no run"""

_CLOSING = """\
Any setting can be replaced: trainer.max_steps=500, energy.lambda_normal=0.1; one that the chosen
option lacks is added with a plus: +optimizer.weight_decay=1e-4. Bad input is told in one line,
with exit status 2. Completion: eval "$(nsm -sc install=bash)" (zsh: bash's with bashcompinit;
fish: nsm -sc install=fish | source). Hydra's own flags: --hydra-help."""


def main(words: list[str]) -> None:
    """Print the help on the groups that words name, or on all in short.

    Raises:
        NsmError: a word that names no group.
    """
    console = Console(highlight=False, soft_wrap=False)
    known = {group.name: group for group in groups()}
    chosen = [word.split("=")[0] for word in words]
    for name in chosen:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
            hint = f"did you mean '{near[0]}'?" if near else f"groups: {', '.join(known)}"
            raise NsmError(f"--help {name}: no group is called so; {hint}")
    if chosen:
        for name in chosen:
            _one(console, known[name])
        return
    console.print(_USAGE)
    console.print("\n[bold]Groups[/bold] and their options, * taken by default\n")
    for group in known.values():
        _short(console, group)
    console.print("[bold]Settings[/bold] outside the groups\n")
    console.print(_settings(ungrouped()))
    console.print()
    console.print(_CLOSING)


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
            console.print(_settings(option.settings))
        console.print()


def _options(group: Group) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=24, no_wrap=True)
    table.add_column(overflow="fold")
    for option in group.options:
        star = "*" if option.name == group.default else " "
        table.add_row(Text(f"  {star} {option.name}"), Text(option.remark))
    return table


def _settings(settings: tuple[Setting, ...]) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=24, overflow="fold")
    table.add_column(overflow="fold")
    for setting in settings:
        table.add_row(Text(f"    {setting.key}={setting.value}"), Text(setting.remark))
    return table
