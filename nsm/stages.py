"""What a run is at: stage, step and time left, never silent for long."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from statistics import median
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


@dataclass
class _Count:
    """Steps of the work: which one it is at, and how long they took.

    The one after ``done`` of ``total``, if they are counted; ``early``: it may be the last. The
    last report was of ``last`` steps, of ``pace`` seconds each, those before it of ``before``.
    """

    step: str = ""
    done: int = 0
    total: int = 0
    early: bool = False
    started: float = field(default_factory=time.monotonic)
    ended: float = field(default_factory=time.monotonic)
    last: int = 1
    pace: float = 0.0
    before: float = 0.0

    def move(self, done: int, total: int) -> None:
        now = time.monotonic()
        if done > self.done:
            self.before, self.last = self.pace, done - self.done
            self.pace = (now - self.ended) / self.last
            self.ended = now
        self.done, self.total = done, total

    @property
    def seconds(self) -> float:
        """Of a step from here on: they may take longer than those before, if two in turn did."""
        mean = (self.ended - self.started) / self.done
        return max(mean, median((self.before, self.pace, self.elapsed / self.last)))

    @property
    def elapsed(self) -> float:
        """Seconds since the last step ended."""
        return time.monotonic() - self.ended

    @property
    def known(self) -> bool:
        return 0 < self.done < self.total


class Stage:
    """A piece of work, and pieces within it, and the step that the innermost is at.

    Args:
        title: of the work.
    """

    def __init__(self, title: str = "") -> None:
        self.titles = [title] if title else []
        self.count, self.outer, self.figures = _Count(), list[_Count](), ""
        self.aside = ""
        self.started = time.monotonic()
        self._ended = threading.Event()

    def at(
        self, step: str, done: int = 0, total: int = 0, figures: str = "", early: bool = False
    ) -> None:
        """Say which step the work is at: the one after ``done`` of ``total``, if it is counted;
        figures that tell how it goes; and whether it may end early."""
        if step != self.count.step or done < self.count.done:
            self.count = _Count(step, done, total)
        self.count.move(done, total)
        self.count.early, self.figures = early, figures

    def text(self, seconds: bool = True) -> str:
        """Titles, step, ``seconds`` so far, the time left of steps that are counted, figures, and
        what the step waits for."""
        so_far = f"{time.monotonic() - self.started:.0f} s" if seconds else ""
        step = self.numbered_step()
        parts = (*self.titles, step, so_far, self._left(), self.figures, self.aside)
        return "  ".join(part for part in parts if part)

    def _left(self) -> str:
        """The time left of all steps that are counted; nothing where one of them is the first."""
        counts = [count for count in (*self.outer, self.count) if count.total]
        if not counts or not all(count.known for count in counts[:-1]):
            return ""
        *outer, inner = counts
        if inner.known:
            left = inner.seconds * (inner.total - inner.done)
        elif outer and inner.done == 0:
            left = max(outer[-1].seconds - outer[-1].elapsed, 0.0)
        elif outer:
            left = 0.0
        else:
            return ""
        left += sum(count.seconds * (count.total - count.done - 1) for count in outer)
        how = "up to" if any(count.early for count in counts) else "about"
        return f"{how} {max(left, 1):.0f} s left"

    def numbered_step(self) -> str:
        """The step that the work is at, with its number if steps are counted."""
        count = self.count
        number = f" {min(count.done + 1, count.total)}/{count.total}" if count.total else ""
        return count.step + number

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

    def at(
        self, step: str, done: int = 0, total: int = 0, figures: str = "", early: bool = False
    ) -> None:
        new = step != self.count.step
        super().at(step, done, total, figures, early)
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
    before, titles, figures = outer.count, outer.titles, outer.figures
    outer.titles = [*titles, *([outer.numbered_step()] if before.total else []), title]
    outer.outer.append(before)
    outer.count, outer.figures = _Count(), ""
    try:
        yield
    finally:
        outer.outer.pop()
        outer.count, outer.titles, outer.figures = before, titles, figures


def report_to(send: Callable[[str], None]) -> None:
    """Let this process, a copy of another, tell that one what it is at.

    Args:
        send: takes a text, of stages and step, whenever that changes; at most a few in a second.
    """
    _current.set(_Reported(send))


def showing() -> bool:
    """Whether a stage is shown."""
    return _current.get() is not None


def at(step: str, done: int = 0, total: int = 0, figures: str = "", early: bool = False) -> None:
    """Say which step the work is at (see :meth:`Stage.at`); without a stage, nothing happens."""
    shown = _current.get()
    if shown is not None:
        shown.at(step, done, total, figures, early)


def waits_for(aside: str) -> None:
    """Say what the step waits for; nothing, if ``aside`` is empty."""
    shown = _current.get()
    if shown is not None:
        shown.aside = aside


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
