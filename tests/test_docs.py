"""The documentation builds without warnings, and what it is made of is all there."""

import os
import re
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

import nsm
from nsm.config import conf_folder
from nsm.config_docs import groups
from nsm.maps import build_analytic

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


class Page(HTMLParser):
    """A page's text, and the ids in it."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.words: list[str] = []
        self.ids: set[str] = set()
        self.feed(file.read_text(encoding="utf-8"))
        self.text = " ".join("".join(self.words).split())

    def handle_starttag(self, tag, attributes):
        self.ids.update(value for key, value in attributes if key == "id")

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    pytest.importorskip("mkdocs", reason="needs nsm[docs]")
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    return folder


def test_every_page_is_reached_from_the_front(site):
    front = (site / "index.html").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert f'href="{page.stem}.html"' in front


def test_settings_are_those_of_the_configuration(site):
    page = Page(site / "settings.html")
    for group in groups():
        files = {file.stem for file in (conf_folder() / group.name).glob("*.yaml")}
        shown = {name for name in files if f"{group.name}={name}" in page.text}
        assert shown == files
        for setting in (s for option in group.options for s in option.settings):
            row = f"{setting.key} {setting.value} {setting.remark}".strip()
            assert row.replace("`", "") in page.text


def test_everything_public_is_in_the_reference(site):
    assert {f"nsm.{name}" for name in nsm.__all__} <= Page(site / "api.html").ids


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_words_of_commands_can_be_read(page):
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    commands = re.findall(r"^(?:\$ )?nsm ([^|\n]*)", text, re.MULTILINE)
    inline = re.findall(r"`(?:nsm )?([\w.+]+=[^`|\n]+)`", text)
    lines = [shlex.split(line, comments=True) for line in [*commands, *inline]]
    words = [
        word
        for line in lines
        if line[0] not in ("report", "view") and not {"...", "-sc"} & set(line)
        for word in line
        if not word.startswith("-") and "=" in word
    ]
    for read in OverridesParser.create().parse_overrides(words):
        if read.get_key_element() == "target" and isinstance(read.value(), dict):
            build_analytic(read.value())
