"""What the files of the configuration say about themselves: groups, options, settings, remarks.

In conf/config.yaml a comment above an entry of the defaults list is the remark on that group. In a
group's file the first comment is the remark on the option; each further one is on the setting
below it. The help screen and the reference pages are made of nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from nsm.config import conf_folder

_PACKAGE = re.compile(r"#\s*@package\s+(\S+)")
_SETTING = re.compile(r"( *)([^\s:#-][^:]*):(?:\s+(.*))?$")
_DEFAULT = re.compile(r"  - (?:override )?([^\s:]+): (\S+)$")


@dataclass(frozen=True)
class Setting:
    """A setting of a file: its dotted key, its value as written, and the remark on it."""

    key: str
    value: str
    remark: str


@dataclass(frozen=True)
class Option:
    """A file of a group: ``GROUP=NAME`` chooses it."""

    name: str
    remark: str
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class Group:
    """A choice: its options, and the one that is taken by default (``null``: none)."""

    name: str
    remark: str
    default: str
    options: tuple[Option, ...]


def groups() -> list[Group]:
    """All groups in the order of the defaults list, but for the task, which comes first.

    A remark on a setting is given in one file, and holds for it in all.
    """
    read = {name: [*_options(name)] for name, _, _ in _defaults_list()}
    settings = [s for options in read.values() for option in options for s in option.settings]
    settings += ungrouped()
    remarks = {s.key: s.remark for s in reversed(settings) if s.remark}

    def filled(option: Option) -> Option:
        full = (replace(s, remark=s.remark or remarks.get(s.key, "")) for s in option.settings)
        return replace(option, settings=tuple(full))

    found = [
        Group(name, remark, default, tuple(map(filled, read[name])))
        for name, default, remark in _defaults_list()
    ]
    return sorted(found, key=lambda group: group.name != "task")


def ungrouped() -> tuple[Setting, ...]:
    """The settings of conf/config.yaml itself."""
    settings = _settings((conf_folder() / "config.yaml").read_text(encoding="utf-8"))
    return tuple(s for s in settings if not s.key.startswith("hydra"))


def _defaults_list() -> Iterator[tuple[str, str, str]]:
    remark: list[str] = []
    for line in (conf_folder() / "config.yaml").read_text(encoding="utf-8").splitlines():
        entry = _DEFAULT.match(line)
        if line.startswith("  #"):
            remark.append(line.strip(" #"))
        elif entry:
            if remark:  # the others are Hydra's, and nothing to choose
                yield entry.group(1), entry.group(2), " ".join(remark)
            remark = []


def _options(group: str) -> Iterator[Option]:
    for file in sorted((conf_folder() / group).glob("*.yaml")):
        yield read_option(file, group)


def read_option(file: Path, group: str) -> Option:
    """The option that a file of a group is."""
    text = file.read_text(encoding="utf-8")
    package = _PACKAGE.match(text)
    prefix = package.group(1) if package else group.replace("/", ".")
    lines = text.splitlines()[1:] if package else text.splitlines()
    remark = lines[0].strip("# ") if lines and lines[0].startswith("#") else ""
    dotted = "" if prefix == "_global_" else f"{prefix}."
    settings = [
        replace(setting, key=dotted + setting.key)
        for setting in _settings("\n".join(lines[1:] if remark else lines))
    ]
    # what the option's name says already is not told again
    said = (group, f"{group}.name", f"{dotted}_target_", "hydra.mode")
    return Option(file.stem, remark, tuple(s for s in settings if s.key not in said))


def _settings(text: str) -> Iterator[Setting]:
    """Every ``key: value`` of a YAML text in block style, with the comment lines above it."""
    above: list[tuple[int, str]] = []  # the mappings that the line is in, with their indentation
    remark: list[str] = []
    for line in text.splitlines():
        found = _SETTING.match(line)
        if line.lstrip().startswith("#"):
            remark.append(line.strip(" #"))
        elif found:
            indent, key, value = len(found.group(1)), found.group(2), found.group(3) or ""
            above = [entry for entry in above if entry[0] < indent]
            if key == "defaults":
                remark = []
            elif value:
                dotted = ".".join([*(name for _, name in above), key])
                yield Setting(dotted, value, " ".join(remark))
                remark = []
            else:
                above.append((indent, key))
        else:
            remark = []
