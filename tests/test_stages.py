"""What a run shows while it does not train."""

import io
import threading
import time
from types import SimpleNamespace

import pytest
from rich.console import Console

from nsm import stages
from nsm.results.progress import TrainingProgress
from nsm.side_by_side import at_once, side_by_side


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


def test_parts_are_named_and_the_step_before_them_comes_back():
    shown = stages.Stage("outer")
    token = stages._current.set(shown)
    try:
        stages.at("pairs", 1, 4)
        with stages.part("inner"):
            stages.at("flips", 2, 3, figures="loss 1")
            assert shown.text(seconds=False) == (
                "outer  pairs 2/4  inner  flips 3/3  about 1 s left  loss 1"
            )
        assert shown.text(seconds=False).startswith("outer  pairs 2/4")
    finally:
        stages._current.reset(token)
    with stages.part("nothing is shown"):
        assert not stages.showing()


def later(begun, seconds):
    begun.count.started -= seconds
    begun.count.ended -= seconds


def test_steps_that_take_longer_than_those_before_them_are_awaited():
    begun = stages.Stage("work")
    begun.at("steps", 1, 4)
    begun.at("steps", 2, 4)
    begun.count.started -= 4  # two steps, two seconds each
    assert "about 4 s left" in begun.text()
    later(begun, 30)  # one slow step says nothing of the others
    assert "about 4 s left" in begun.text()
    begun.at("steps", 3, 4)
    later(begun, 20)
    assert "about 20 s left" in begun.text()
    begun.at("steps", 4, 4)
    assert "left" not in begun.text()


def test_steps_after_the_present_one_count_and_may_be_the_last():
    begun = stages.Stage("work")
    token = stages._current.set(begun)
    try:
        begun.at("step", 2, 4, early=True)
        begun.count.started -= 10  # two steps, five seconds each
        with stages.part("inner"):
            begun.at("iteration", 1, 3)
            begun.count.started -= 1
            # two iterations, and the step after this one
            assert "up to 7 s left" in begun.text()
        begun.at("step", 3, 4)  # ten seconds for three steps
        assert "about 3 s left" in begun.text()
    finally:
        stages._current.reset(token)


def test_steps_that_are_reported_together_share_their_time():
    begun = stages.Stage("work")
    begun.at("faces", 0, 1000)
    for done in (100, 200):
        later(begun, 10)
        begun.at("faces", done, 1000)
    later(begun, 5)
    assert "about 80 s left" in begun.text()


def test_lines_keep_coming_however_long_it_lasts(often):
    console = Console(file=io.StringIO())
    begun = stages.Stage("long")
    begun.started -= 3600
    end = time.monotonic() + 20
    thread = threading.Thread(target=begun.show, args=(console,))
    thread.start()
    while console.file.getvalue().count("\n") < 5 and time.monotonic() < end:
        time.sleep(0.02)
    begun.end()
    thread.join()
    assert console.file.getvalue().count("\n") >= 5


@pytest.mark.skipif(at_once(2, 2) < 2, reason="processes cannot be forked here")
def test_other_processes_say_what_they_are_at(often):
    console = Console(file=io.StringIO(), width=200)

    def work(name):
        with stages.stage(Console(quiet=True), name):
            for _ in stages.counted("cells", range(4)):
                time.sleep(0.2)
        return name

    with stages.stage(console, "all"):
        assert side_by_side([lambda: work("a"), lambda: work("b")], 2) == ["a", "b"]
    said = console.file.getvalue()
    assert "a  cells" in said and "; b  cells" in said and "left" in said


def test_a_training_says_its_step_while_that_lasts(often):
    console = Console(file=io.StringIO(), width=200)
    progress = TrainingProgress(console, "training")
    trainer = SimpleNamespace(
        global_step=1, max_steps=5, should_stop=False, callback_metrics={"val/rms_percent": 2.0}
    )
    progress.on_train_start(trainer, None)
    progress.shown -= 1
    progress.on_train_batch_end(trainer, None, {"loss": 0.5}, None, 0)
    end = time.monotonic() + 20
    while console.file.getvalue().count("2/5") < 3 and time.monotonic() < end:
        time.sleep(0.02)
    progress.on_train_end(trainer, None)
    assert not stages.showing()
    lines = [line for line in console.file.getvalue().splitlines() if "2/5" in line]
    assert len(lines) >= 3 and "loss 5.00e-01  error 2.000 %" in lines[-1]


def test_a_training_that_ends_early_says_so():
    console = Console(file=io.StringIO(), width=200)
    progress = TrainingProgress(console, "training")
    trainer = SimpleNamespace(global_step=3, max_steps=5, should_stop=True, callback_metrics={})
    progress.on_train_start(trainer, None)
    progress.on_train_end(trainer, None)
    assert "training: settled after 3 steps, of 5 at most" in console.file.getvalue()


def test_works_in_turn_are_counted_and_named(monkeypatch):
    done, told = [], []
    monkeypatch.setattr(stages, "at", lambda *of: told.append(of))
    stages.done_in_turn("files", {"a": lambda: done.append(1), "b": lambda: done.append(2)})
    assert done == [1, 2] and told == [("files", 0, 2, "a"), ("files", 1, 2, "b")]


def test_silence_before_a_stage_counts_and_lines_of_others_end_it(monkeypatch):
    monkeypatch.setattr(stages, "QUIET_FOR", 50.0)
    console = Console(file=io.StringIO())
    assert shown(console) == ""
    console.print("a line")
    monkeypatch.setattr(stages._heard, "last", time.monotonic() - 50)
    with stages.stage(console, "work"):
        end = time.monotonic() + 20  # a busy machine takes its time
        while "work" not in console.file.getvalue() and time.monotonic() < end:
            time.sleep(0.05)
    assert console.file.getvalue().count("work") == 1
    monkeypatch.setattr(stages._heard, "last", time.monotonic() - 50)
    console.print("another line")
    assert shown(console).endswith("another line\n")
