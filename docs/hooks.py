"""What mkdocs lacks: the pages generated from README.md and the configuration; the navigation."""

from __future__ import annotations

import re
import sys
from html import escape
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from nsm.config import composed  # noqa: E402
from nsm.help import (  # noqa: E402
    Group,
    Setting,
    groups,
    option_settings,
    plain_settings,
)

FIRST = ("tutorial.md", "tutorial_texture.md", "tutorial_scans.md", "extending.md")
REFERENCE = ("settings.md", "api.md")


def on_config(config: Any) -> Any:
    """The navigation: every page of docs/ is in it, whoever adds one."""
    pages = sorted(file.name for file in Path(config.docs_dir).glob("*.md"))
    guides = [page for page in pages if page not in (*FIRST, *REFERENCE)]
    first = [page for page in FIRST if page in pages]
    config.nav = [
        {"nsm": "index.md"},
        *first,
        {"Guides": guides},
        {"Reference": [{"Settings": "settings.md"}, {"API": "api.md"}]},
    ]
    return config


def on_files(files: Files, config: Any) -> Files:
    """The front page, the settings, and the results of the benchmarks that pages link to."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=front_page(readme)))
    files.append(File.generated(config, "settings.md", content=settings_page()))
    for name in ("LICENSE", "SECURITY.md"):
        if f"]({name}" in readme:
            text = (ROOT / name).read_text(encoding="utf-8")
            files.append(File.generated(config, name, content=text))
    for result in sorted((ROOT / "benchmarks" / "results").rglob("*")):
        if result.is_file():
            name = result.relative_to(ROOT).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(result)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links to the repository's files outside docs/ become links to their copies in the site.

    A folder of results is no page, and is named only.
    """
    inside = re.sub(r"\]\(\.\./(benchmarks|README\.md|SECURITY\.md)", _inside, markdown)
    return re.sub(r"\[([^\]]*)\]\((benchmarks/[^)#]*)\)", _result, inside)


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Docstrings name code by roles, which Markdown does not know."""
    return re.sub(r":(func|class|mod|meth):(?=<code>|<span)", "", html)


def _inside(link: re.Match[str]) -> str:
    return "](" + link.group(1).replace("README.md", "index.md")


def front_page(readme: str) -> str:
    """README.md as a page of docs/."""
    return readme.replace("](docs/", "](")


def _result(link: re.Match[str]) -> str:
    return link.group(0) if (ROOT / link.group(2)).is_file() else link.group(1)


def settings_page() -> str:
    """The reference of all groups, options and settings, as `nsm --help` has them."""
    parts = [
        "# Settings",
        "`GROUP=OPTION` chooses an option of a group, `SETTING=VALUE` sets a setting. What stands "
        "under an option are the parameters of the class that its `_target_` names; "
        "`GROUP._target_=MODULE.CLASS` chooses another class, also one of yours "
        "([Extending](extending.md)). `nsm --help NAME` shows the same in the terminal.",
        *map(_group, groups()),
        "## Outside the groups",
        "The values are those of a run without further settings; tasks and experiments set others.",
        _table(plain_settings(composed()[0])),
    ]
    return "\n\n".join(parts) + "\n"


def _group(group: Group) -> str:
    default = f"By default `{group.name}={group.default}`." if group.default != "null" else ""
    parts = [f"## {group.name}", f"{_text(group.remark[:1].upper() + group.remark[1:])}.", default]
    for option, remark in group.options.items():
        settings = option_settings(group.name, option)
        parts += [f"### {group.name}={option}", _text(remark)]
        parts += [_table(settings)] if settings else []
    return "\n\n".join(part for part in parts if part)


def _table(settings: list[Setting]) -> str:
    rows = [f"| `{s.key}` | {_code(s.value)} | {_text(s.remark)} |" for s in settings]
    return "\n".join(["| setting | value | |", "|---|---|---|", *rows])


def _code(value: str) -> str:
    return f"<code>{_plain(value)}</code>"


def _text(remark: str) -> str:
    """A remark as Markdown: only what stands between backticks is markup."""
    parts = remark.split("`")
    return "".join(_code(part) if k % 2 else _plain(part) for k, part in enumerate(parts))


def _plain(text: str) -> str:
    plain = escape(text, quote=False)
    return re.sub(r"[|*_\[\]{}]", lambda sign: f"&#{ord(sign.group())};", plain)
