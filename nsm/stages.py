"""What a run is at: stage, step and time left, never silent for long."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar
from weakref import WeakSet

from rich.console import Console, ConsoleRenderable, RenderHook

# seconds without a line after which one is printed where there is no terminal
QUIET_FOR = 2.0
_OFTEN = 0.2  # seconds between two updates of one line, or two reports of another process

T = TypeVar("T")


class _Heard(RenderHook):
    """When a line was last printed, by whatever part of the program."""

    def __init__(self) -> None:
        self.last = time.monotonic()
        self.consoles: WeakSet[Console] = WeakSet()

    def listen(self, console: Console) -> None:
        """Notice what a console prints from now on."""
        if console not in self.consoles:
            self.consoles.add(console)
            console.push_render_hook(self)

    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        self.last = time.monotonic()
        return renderables


_heard = _Heard()


class Stage:
    """A piece of work, and pieces within it, and the step that the innermost is at.

    Args:
        title: of the work.
    """

    def __init__(self, title: str = "") -> None:
        self.titles = [title] if title else []
        self.step, self.figures, self.done, self.total = "", "", 0, 0
        self.started = self.step_started = self.step_ended = time.monotonic()
        self.last, self.pace = 1, 0.0  # steps between the last two reports, and seconds for each
        self._ended = threading.Event()

    def at(self, step: str, done: int = 0, total: int = 0, figures: str = "") -> None:
        """Say which step the work is at: the one after ``done`` of ``total``, if it is counted;
        and figures that tell how it goes."""
        now = time.monotonic()
        if step != self.step or done < self.done:
            self.step_started, self.last, self.pace = now, 1, 0.0
        elif done > self.done:
            self.last = done - self.done
            self.pace = (now - self.step_ended) / self.last
        if done != self.done:
            self.step_ended = now
        self.step, self.done, self.total, self.figures = step, done, total, figures

    def text(self, seconds: bool = True) -> str:
        """Titles, step, ``seconds`` so far, the time left of a step that is counted, figures."""
        now = time.monotonic()
        so_far = f"{now - self.started:.0f} s" if seconds else ""
        parts = [*self.titles, self.numbered_step(), so_far]
        if 0 < self.done < self.total:
            # steps may take longer from here on: so do those left, if two of them in turn did
            mean = (self.step_ended - self.step_started) / self.done
            slow = min(self.pace, (now - self.step_ended) / self.last)
            left = max(mean, slow) * (self.total - self.done)
            parts.append(f"about {max(left, 1):.0f} s left")
        return "  ".join(part for part in (*parts, self.figures) if part)

    def numbered_step(self) -> str:
        """The step that the work is at, with its number if steps are counted."""
        number = f" {min(self.done + 1, self.total)}/{self.total}" if self.total else ""
        return self.step + number

    def show(self, console: Console) -> None:
        """Show it until it ends: a line that is updated on a terminal, plain lines elsewhere."""
        if console.is_terminal:
            with console.status(self.text()) as status:
                while not self._ended.wait(_OFTEN):
                    status.update(self.text())
            return
        _heard.listen(console)

        def left() -> float:
            # work between this and what printed before it was silent too; 0.8: others may hold the
            # interpreter
            quiet_for = 0.8 * QUIET_FOR
            return max(min(_OFTEN, quiet_for), _heard.last + quiet_for - time.monotonic())

        while not self._ended.wait(left()):
            console.print(self.text(), soft_wrap=True)

    def end(self) -> None:
        """Stop showing it."""
        self._ended.set()


class _Reported(Stage):
    """The work of a process, told to the one that started it.

    Args:
        send: takes a text.
    """

    def __init__(self, send: Callable[[str], None]) -> None:
        super().__init__()
        self.send, self.sent = send, 0.0

    def at(self, step: str, done: int = 0, total: int = 0, figures: str = "") -> None:
        new = step != self.step
        super().at(step, done, total, figures)
        now = time.monotonic()
        if new or now - self.sent > _OFTEN:
            self.sent = now
            self.send(self.text(seconds=False))


_current: ContextVar[Stage | None] = ContextVar("stage", default=None)


@contextmanager
def stage(console: Console, title: str) -> Iterator[None]:
    """Show that a piece of work goes on, as long as it does; within another, as a part of it."""
    if console.quiet or showing():
        with part(title):
            yield
        return
    shown = Stage(title)
    token = _current.set(shown)
    thread = threading.Thread(target=shown.show, args=(console,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        shown.end()
        thread.join()
        _current.reset(token)


@contextmanager
def part(title: str) -> Iterator[None]:
    """Name a part of the work that is shown, if there is any, for as long as it lasts: after the
    step that it is within, if steps are counted."""
    outer = _current.get()
    if outer is None:
        yield
        return
    before = outer.step, outer.done, outer.total
    titles = outer.titles
    outer.titles = [*titles, *([outer.numbered_step()] if outer.total else []), title]
    outer.at("")
    try:
        yield
    finally:
        outer.titles = titles
        outer.at(*before)


def report_to(send: Callable[[str], None]) -> None:
    """Let this process, a copy of another, tell that one what it is at.

    Args:
        send: takes a text, of stages and step, whenever that changes; at most a few in a second.
    """
    _current.set(_Reported(send))


def showing() -> bool:
    """Whether a stage is shown."""
    return _current.get() is not None


def at(step: str, done: int = 0, total: int = 0, figures: str = "") -> None:
    """Say which step the work is at (see :meth:`Stage.at`); without a stage, nothing happens."""
    shown = _current.get()
    if shown is not None:
        shown.at(step, done, total, figures)


def counted(step: str, items: Sequence[T]) -> Iterator[T]:
    """The items, one after the other, each said to be a step of the work."""
    for k, item in enumerate(items):
        at(step, k, len(items))
        yield item


def done_in_turn(step: str, works: Mapping[str, Callable[[], object]]) -> None:
    """Do pieces of work one after the other, each a counted step of the work, with its name."""
    for k, (name, work) in enumerate(works.items()):
        at(step, k, len(works), name)
        work()
