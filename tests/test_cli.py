"""The command's first word: a command of its own, or the settings of a task."""

import sys
import types
from importlib.metadata import version

import pytest

from nsm import cli
from nsm.arguments import Arguments


@pytest.fixture
def echo(monkeypatch):
    """A command ``echo FOLDER`` in the table; what it was called with."""
    seen: list[str] = []

    def main(words: list[str]) -> None:
        parser = Arguments(prog="nsm echo")
        parser.add_argument("folder")
        seen.append(parser.parse_args(words).folder)

    module = types.ModuleType("echo_command")
    module.main = main
    monkeypatch.setitem(sys.modules, "echo_command", module)
    monkeypatch.setitem(cli.COMMANDS, "echo", "echo_command")
    return seen


def test_a_command_gets_the_words_after_its_name(echo, here):
    result = here("echo", "runs")
    assert (result.returncode, echo) == (0, ["runs"])


def test_a_mistaken_command_line_is_one_line_and_status_2(echo, here):
    result = here("echo", "runs", "--loud")
    assert result.returncode == 2
    assert result.stderr.strip().splitlines() == [
        "nsm: unrecognized arguments: --loud; see nsm echo --help"
    ]
    assert echo == []


def test_other_words_are_settings(echo, here):
    result = here("eco")
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--foo"], "--foo: no flag is called so"),
        (["-m", "--foo", "seed=1,2"], "--foo: no flag is called so"),
        (["seed=1", "-m", "domain=disc,square"], "domain=disc,square: give flags, such as -m, bef"),
        (["--cfg", "jobs"], "'jobs'"),
        (["--resolve"], "--cfg job"),
        (["--experimental-rerun", "gone.pickle"], "nsm resume=FOLDER"),
        (["-m", "--cfg", "job"], "exclude each other"),
    ],
)
def test_a_mistaken_flag_is_told_in_one_line(here, words, told):
    result = here(*words)
    assert (result.returncode, result.stdout) == (2, "")
    assert told in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_the_version_is_ours(here):
    assert here("--version").stdout == f"nsm {version('nsm')}\n"
