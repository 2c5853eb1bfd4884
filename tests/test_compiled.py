"""Compiled functions: told while they are compiled, kept, and made anew where nothing is kept."""

import gc

import numpy as np

from nsm import stages
from nsm.compiled import compiled

SOURCE = """
def double(x):
    for k in range(len(x)):
        x[k] *= 2
"""


def new():
    """A function that no file holds, so that no machine code of it is kept."""
    scope = {}
    exec(SOURCE, scope)
    return scope["double"]


def test_who_waits_is_told_that_a_function_is_compiled(monkeypatch):
    said = []
    monkeypatch.setattr("nsm.compiled.waits_for", said.append)
    compiled(new())(np.ones(3))
    assert said[0].startswith("compiling") and said[-1] == ""
    assert gc.isenabled()


def test_what_a_step_waits_for_is_in_its_line():
    shown = stages.Stage("work")
    token = stages._current.set(shown)
    try:
        stages.at("a step")
        stages.waits_for("a compiler")
        assert shown.text(seconds=False) == "work  a step  a compiler"
        stages.waits_for("")
        assert shown.text(seconds=False) == "work  a step"
    finally:
        stages._current.reset(token)


def test_functions_are_compiled_where_no_folder_keeps_them():
    x = np.ones(3)
    compiled(new())(x)
    assert x.tolist() == [2, 2, 2]


def test_division_by_zero_is_numpys():
    def divided(x, y):
        return x / y

    assert compiled(divided)(1.0, 0.0) == np.inf
