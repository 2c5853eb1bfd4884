"""What a run shows while it does not train."""

import io
import time

import pytest
from rich.console import Console

from nsm import stages


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(stages, "QUIET_FOR", 0.05)


def shown(console, seconds=0.4):
    with stages.stage(console, "outer"), stages.stage(console, "inner"):
        stages.at("seams", 1, 4)
        time.sleep(seconds)
    return console.file.getvalue()


def test_lines_where_there_is_no_terminal(often):
    console, lines = Console(file=io.StringIO()), []
    with stages.stage(console, "outer"), stages.stage(console, "inner"):
        stages.at("seams", 1, 4)
        end = time.monotonic() + 20  # a busy machine takes its time
        while len(lines) < 3 and time.monotonic() < end:
            time.sleep(0.05)
            lines = console.file.getvalue().splitlines()
    assert len(lines) >= 3
    assert all("outer" in line and "2/4" in line and "left" in line for line in lines)


def test_one_updated_line_on_a_terminal():
    assert "outer" in shown(Console(file=io.StringIO(), force_terminal=True, width=90))


def test_quiet_is_silent_and_short_work_too(often):
    assert shown(Console(file=io.StringIO(), quiet=True)) == ""
    assert shown(Console(file=io.StringIO()), seconds=0) == ""


def test_an_exception_ends_it_and_steps_outside_are_ignored(often):
    console = Console(file=io.StringIO())
    with pytest.raises(KeyboardInterrupt), stages.stage(console, "work"):
        raise KeyboardInterrupt
    written = console.file.getvalue()
    stages.at("nothing")
    time.sleep(0.2)
    assert console.file.getvalue() == written
