"""Calls in processes of their own: results, errors, interrupts as one after the other has them."""

import multiprocessing
import os
import signal
import threading
import time

import numpy as np
import pytest

from nsm.errors import NotTrusted, NsmError
from nsm.side_by_side import apart, at_once, side_by_side

pytestmark = pytest.mark.skipif(at_once(2, 2) < 2, reason="processes cannot be forked here")


def failing(error):
    def call():
        raise error

    return call


def children():
    return multiprocessing.active_children()


def test_results_are_those_of_one_after_the_other():
    calls = [lambda k=k: (np.arange(3) * k, os.getpid()) for k in range(5)]
    here, there = side_by_side(calls, 1), side_by_side(calls, 2)
    for (a, own), (b, other) in zip(here, there, strict=True):
        np.testing.assert_array_equal(a, b)
        assert own == os.getpid() != other
    assert not children()


def test_two_run_at_once(tmp_path):
    """Each waits for what the other writes."""

    def meet(own, other):
        (tmp_path / own).touch()
        for _ in range(500):
            if (tmp_path / other).exists():
                return own
            time.sleep(0.01)
        return None

    assert side_by_side([lambda: meet("a", "b"), lambda: meet("b", "a")], 2) == ["a", "b"]


def test_the_first_failure_in_order_is_raised_and_the_rest_are_stopped():
    def late():
        time.sleep(0.3)
        raise NsmError("first", kind="missing_file", key="a.obj")

    def endless():
        time.sleep(60)

    start = time.monotonic()
    with pytest.raises(NsmError, match="first") as error:
        side_by_side([late, failing(NsmError("second")), endless], 3)
    assert (error.value.kind, error.value.key) == ("missing_file", "a.obj")
    assert time.monotonic() - start < 20 and not children()


class Odd(Exception):
    """It cannot be pickled."""

    def __init__(self, a, b):
        super().__init__(f"{a} and {b}")


@pytest.mark.parametrize(
    ("error", "kind", "words"),
    [
        (ValueError("seven"), ValueError, "seven"),
        (NotTrusted("mine.Class"), NsmError, "mine.Class"),
        (Odd(1, 2), RuntimeError, "1 and 2"),
    ],
)
def test_errors_say_what_they_said(error, kind, words):
    with pytest.raises(kind, match=words):
        side_by_side([failing(error), lambda: 1], 2)


def test_a_killed_process_is_one_line():
    with pytest.raises(NsmError) as error:
        side_by_side([lambda: os.kill(os.getpid(), signal.SIGKILL), lambda: 1], 2)
    assert (error.value.kind, error.value.key) == ("failed_process", "phi.processes")


def test_an_interrupt_reaches_all(tmp_path):
    def until_interrupted(name):
        try:
            (tmp_path / f"{name} began").touch()
            time.sleep(60)
        except KeyboardInterrupt:
            (tmp_path / f"{name} ended").touch()
            raise

    def interrupt():
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.01)
        time.sleep(0.5)  # logging's hooks after a fork swallow what is raised in them
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        side_by_side([lambda: until_interrupted("a"), lambda: until_interrupted("b")], 2)
    assert {p.name for p in tmp_path.glob("* ended")} == {"a ended", "b ended"} and not children()


def test_how_many_at_once():
    assert at_once(3, 1) == 1 and at_once(1, 8) == 1 and at_once(3, 2) == 2
    assert 1 <= at_once(100, None) <= os.cpu_count()


def test_one_call_runs_apart():
    """Its result and error come back; the thread that shows the work is not held up meanwhile."""
    assert apart(lambda: os.getpid()) != os.getpid()
    with pytest.raises(NsmError) as caught:
        apart(failing(NsmError("no", kind="missing_file", key="a.obj")))
    assert (caught.value.kind, caught.value.key) == ("missing_file", "a.obj")
    assert not children()
