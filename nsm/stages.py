"""What a run is at while it does not train: stage, step and time left, never silent for long."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console

# seconds without a line after which one is printed where there is no terminal; in long runs the
# share of the time that has passed, so that a log stays short
QUIET_FOR, QUIET_SHARE = 2.0, 0.02

T = TypeVar("T")


class Stage:
    """A piece of work that is shown while it lasts.

    Args:
        console: where to write; a line that is updated on a terminal, plain lines elsewhere.
        title: of the work.
    """

    def __init__(self, console: Console, title: str) -> None:
        self.console, self.title = console, title
        self.step, self.done, self.total = "", 0, 0
        self.started = self.step_started = time.monotonic()
        self._ended = threading.Event()

    def at(self, step: str, done: int = 0, total: int = 0) -> None:
        """Say which step the work is at: the one after ``done`` of ``total``, if it is counted."""
        if step != self.step:
            self.step_started = time.monotonic()
        self.step, self.done, self.total = step, done, total

    def text(self) -> str:
        """Title, step, seconds, and the time left of a step that is counted."""
        now = time.monotonic()
        parts = [self.title, self.step, f"{now - self.started:.0f} s"]
        if self.total:
            parts[1] += f" {min(self.done + 1, self.total)}/{self.total}"
            if self.done:
                left = (now - self.step_started) / self.done * (self.total - self.done)
                parts.append(f"about {left:.0f} s left")
        return "  ".join(part for part in parts if part)

    def _show(self) -> None:
        if self.console.is_terminal:
            with self.console.status(self.text()) as status:
                while not self._ended.wait(0.2):
                    status.update(self.text())
            return
        wait = QUIET_FOR
        while not self._ended.wait(wait * 0.8):  # 0.8: others may hold the interpreter
            self.console.print(self.text(), soft_wrap=True)
            wait = max(QUIET_FOR, QUIET_SHARE * (time.monotonic() - self.started))


_current: ContextVar[Stage | None] = ContextVar("stage", default=None)


@contextmanager
def stage(console: Console, title: str) -> Iterator[None]:
    """Show that a piece of work goes on, for as long as it does. Within another, its title is
    that one's step."""
    outer = _current.get()
    if outer is not None or console.quiet:
        at(title)
        yield
        return
    shown = Stage(console, title)
    token = _current.set(shown)
    thread = threading.Thread(target=shown._show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        shown._ended.set()
        thread.join()
        _current.reset(token)


def at(step: str, done: int = 0, total: int = 0) -> None:
    """Say which step the work is at (see :meth:`Stage.at`); without a stage, nothing happens."""
    shown = _current.get()
    if shown is not None:
        shown.at(step, done, total)


def counted(step: str, items: Sequence[T]) -> Iterator[T]:
    """The items, one after the other, each said to be a step of the work."""
    for k, item in enumerate(items):
        at(step, k, len(items))
        yield item
