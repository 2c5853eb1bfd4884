"""Functions of arrays that are compiled where many small array operations would take longer."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import TypeVar, cast

import numba
from numba.core import event

from nsm.stages import waits_for

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """A function of numpy arrays and numbers, compiled by numba when it is first called.

    The machine code is kept beside the source file, or in the user's cache where that folder is
    read-only; where neither can be written, each process compiles for itself. Numba notices changes
    of the file alone: a compiled function may call others of its own module only.

    Floating-point arithmetic is as numpy's: dividing by zero gives ∞ or NaN, nothing is reordered.

    Args:
        function: in the part of Python that numba knows.
    """

    def made(kept: bool) -> F:
        return cast(F, numba.njit(cache=kept, nogil=True, error_model="numpy")(function))

    try:
        return made(kept=True)
    except RuntimeError:  # no folder for the machine code
        return made(kept=False)


class _Told(event.Listener):
    """Tells those who wait that a function is compiled: in less time without the collection of
    garbage."""

    def __init__(self) -> None:
        self.depth, self.collects = 0, False

    def on_start(self, event: event.Event) -> None:
        if not self.depth:
            waits_for("compiling, the first time only")
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: event.Event) -> None:
        self.depth -= 1
        if not self.depth:
            waits_for("")
            if self.collects:
                gc.enable()


event.register("numba:compile", _Told())
