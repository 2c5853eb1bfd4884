"""torch, Lightning and others are imported when they are needed, and take seconds then."""

from __future__ import annotations

import gc
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading_libraries(*, frozen: bool = False) -> Iterator[None]:
    """Import libraries in three quarters of the time, and leave Python's random state as it was.

    An import makes a million objects that stay, and the garbage collector would look through all
    of them again and again: it rests meanwhile. Lightning draws random numbers when it is imported.

    Args:
        frozen: spare later collections these objects as well, if torch is new among them. For a
            process of nsm's own: garbage that is there already is never collected.
    """
    first, collecting, state = "torch" not in sys.modules, gc.isenabled(), random.getstate()
    gc.disable()
    try:
        yield
    finally:
        if frozen and first and "torch" in sys.modules:
            gc.freeze()
        if collecting:
            gc.enable()
        random.setstate(state)
