"""The code blocks of README.md and docs/, and the commands in them.

A fenced block names its language. ``python`` blocks are run, ``sh`` blocks are checked line by
line, all other languages are output or data. The comment ``<!-- not run: REASON -->`` before a
block excuses it from both; ``<!-- needs: PACKAGE -->`` does where the package is not installed.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override
from omegaconf import DictConfig, OmegaConf

from nsm import api

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

_BLOCK = re.compile(
    r"^(?:<!-- (?:not run: (?P<reason>[^\n]+?)|needs: (?P<needs>\w+)) -->\n+)?"
    r"^```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
_FLAGS_WITH_VALUE = {"--cfg", "-c", "--config-dir", "-cd", "--package"}


class Block(NamedTuple):
    """A fenced block: its page, first line, language, text and why it is not run, if it is not."""

    page: Path
    line: int
    language: str
    text: str
    reason: str | None


def blocks(page: Path, language: str | None = None) -> list[Block]:
    """The blocks of a page, or those of one language that are not excused."""
    text = page.read_text(encoding="utf-8")
    found = [
        Block(
            page,
            text.count("\n", 0, match.start("text")),
            match["language"],
            match["text"],
            match["reason"] or _missing(match["needs"]),
        )
        for match in _BLOCK.finditer(text)
    ]
    if language is None:
        return found
    return [block for block in found if block.language == language and block.reason is None]


def _missing(package: str | None) -> str | None:
    """Why a block that needs a package is not run."""
    if package is None or find_spec(package) is not None:
        return None
    return f"needs {package}"


def run_python(page: Path, names: dict[str, Any] | None = None) -> dict[str, Any]:
    """Run the ``python`` blocks of a page in turn, in one namespace, which is returned."""
    names = {"__name__": "page"} if names is None else names
    for block in blocks(page, "python"):
        # tracebacks name the line of the page
        code = compile("\n" * block.line + block.text, str(page), "exec")
        exec(code, names)
    return names


@contextmanager
def short_trainings() -> Iterator[None]:
    """What functions of :mod:`nsm.api` train takes few steps on few samples, whatever is asked."""
    few = {"trainer.max_steps": 20, "data.batch_size": 512, "data.held_out": 512}

    def shortened(*given: Any, **settings: Any) -> DictConfig:
        config = compose(*given, **settings)
        for key, most in few.items():
            if (asked := OmegaConf.select(config, key)) is not None:
                OmegaConf.update(config, key, min(asked, most))
        config.phi.overrides = [*config.phi.overrides, *(f"{k}={v}" for k, v in few.items())]
        return config

    with pytest.MonkeyPatch.context() as patch:
        compose = api.compose_config
        patch.setattr(api, "compose_config", shortened)
        yield


def commands(page: Path) -> list[list[str]]:
    """The words of each command in the ``sh`` blocks of a page."""
    lines = [
        line
        for block in blocks(page, "sh")
        for line in block.text.replace("\\\n", " ").splitlines()
    ]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def prose(page: Path) -> str:
    """The text of a page without its blocks."""
    return _BLOCK.sub("", page.read_text(encoding="utf-8"))


def inline_code(page: Path) -> list[str]:
    """The spans of code in a page's text."""
    return re.findall(r"`([^`\n]+)`", prose(page))


def overrides(words: list[str]) -> list[str]:
    """The settings of an ``nsm`` command, without its flags; ``nsm FILE`` sets the surface."""
    left = iter(words)
    kept = []
    for word in left:
        if word in _FLAGS_WITH_VALUE:
            next(left)
        elif not word.startswith("-"):
            kept.append(word if "=" in word else f"surface.path={word}")
    return kept


def jobs(words: list[str]) -> list[list[str]]:
    """Overrides without sweeps: each value of a sweep is in one of them."""
    columns = [_values(o) for o in OverridesParser.create().parse_overrides(words)]
    rows = zip_longest(*columns)
    return [
        [word or column[0] for word, column in zip(row, columns, strict=True)] for row in rows
    ] or [[]]


def _values(override: Override) -> list[str]:
    if not override.is_sweep_override():
        return [str(override.input_line)]
    key = override.get_key_element()
    swept = override.value()
    if isinstance(swept, IntervalSweep):
        return [f"{key}={swept.start}", f"{key}={swept.end}"]
    return [f"{key}={value}" for value in override.sweep_string_iterator()]
