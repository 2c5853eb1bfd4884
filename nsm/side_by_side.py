"""Independent pieces of work, several at once, each in a forked process on a core of its own."""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar, cast

from nsm.errors import NsmError
from nsm.stages import at, report_to

T = TypeVar("T")
_PATIENCE = 10.0  # seconds that an interrupted process has for its checkpoint
_STEP, _DONE, _FAILED = range(3)  # what a process sends: what it is at, its result, its error


def cores() -> int:
    """The CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def at_once(count: int, processes: int | None) -> int:
    """How many of ``count`` calls run at once, where so many processes are allowed (None: as many
    as there are cores). One where the system cannot fork safely, or in a process that may not have
    children."""
    return min(count, processes or cores()) if _can_fork() else 1


def _can_fork() -> bool:
    there = hasattr(os, "fork") and sys.platform != "darwin"
    return there and not multiprocessing.current_process().daemon


def apart(call: Callable[[], T]) -> T:
    """The result of a call in a process of its own, where there can be one: this one can be
    interrupted meanwhile, and shows that the work goes on, whatever library holds the interpreter
    there. Errors as for :func:`side_by_side`."""
    return _in_processes([call], 1)[0] if _can_fork() else call()


def side_by_side(calls: Sequence[Callable[[], T]], processes: int | None = None) -> list[T]:
    """The results of calls, in their order, as one after the other would give them.

    Each call runs in a process of its own, a copy of this one: what it changes here, prints or
    draws of this process's random numbers is lost, but for files. Where only one can run at a time
    (see :func:`at_once`), all run in this process.

    Args:
        calls: without arguments; their results can be pickled.
        processes: at most so many at once; None: as many as there are cores.

    Raises:
        Exception: that of the first of the calls that fails; the others are stopped.
        KeyboardInterrupt: the others are interrupted too, and awaited.
        NsmError: ``failed_process``: a process was killed.
    """
    most = at_once(len(calls), processes)
    return [call() for call in calls] if most < 2 else _in_processes(calls, most)


def _in_processes(calls: Sequence[Callable[[], T]], most: int) -> list[T]:
    """As :func:`side_by_side`, at most so many at once, each in a process."""
    context = multiprocessing.get_context("fork")
    waiting = deque(enumerate(calls))
    running: dict[Connection, tuple[int, BaseProcess]] = {}
    results: dict[int, T] = {}
    failures: dict[int, BaseException] = {}
    steps: dict[int, str] = {}  # what each is at
    how = signal.SIGINT
    try:
        while running or (waiting and not failures):
            while waiting and not failures and len(running) < most:
                number, call = waiting.popleft()
                receiver, sender = context.Pipe(duplex=False)
                process: BaseProcess = context.Process(
                    target=_answer, args=(call, sender), daemon=True
                )
                running[receiver] = number, process  # known before an interrupt can come
                _start(process)
                sender.close()  # if the process dies, which has the other one, waiting ends
            for receiver in [end for end in wait(list(running)) if isinstance(end, Connection)]:
                number, process = running[receiver]
                kind, value = _received(receiver, process)
                if kind == _STEP:
                    steps[number] = value
                else:
                    del running[receiver]
                    steps.pop(number, None)
                    (results if kind == _DONE else failures)[number] = value
                at("; ".join(steps[k] for k in sorted(steps) if steps[k]))
            # a call before the one that failed might fail too: it is the one to report
            if failures and all(number > min(failures) for number, _ in running.values()):
                break
        how = signal.SIGTERM
    finally:
        _stop([process for _, process in running.values()], how)
    if failures:
        raise failures[min(failures)]
    return [results[number] for number in range(len(calls))]


def _start(process: BaseProcess) -> None:
    with warnings.catch_warnings():
        # other threads draw the progress; the copy has none of them and prints nothing
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()


def _answer(call: Callable[[], Any], sender: Connection) -> None:
    """Send back what a call in the new process is at, and its result or error."""
    # another thread may have held the locks of the real ones at the fork
    sys.stdout = sys.stderr = io.StringIO()
    report_to(lambda text: sender.send_bytes(pickle.dumps((_STEP, text))))
    try:
        answer = pickle.dumps((_DONE, call()))
    except KeyboardInterrupt:
        os._exit(130)
    except BaseException as error:
        answer = pickle.dumps((_FAILED, _portable(error)))
    sender.send_bytes(answer)


def _portable(error: BaseException) -> BaseException:
    """An exception that can be pickled, and says what this one says."""
    if isinstance(error, NsmError):
        return NsmError(str(error), kind=error.kind, key=error.key)
    with suppress(Exception):
        if str(pickle.loads(pickle.dumps(error))) == str(error):
            return error
    return RuntimeError("".join(traceback.format_exception_only(type(error), error)).strip())


def _received(receiver: Connection, process: BaseProcess) -> tuple[int, Any]:
    """What a process sends; after its answer it has ended."""
    try:
        answer: tuple[int, Any] = pickle.loads(receiver.recv_bytes())
        if answer[0] == _STEP:
            return answer
    except EOFError:
        process.join()
        if process.exitcode == 130:
            raise KeyboardInterrupt from None
        reason = NsmError(
            f"a process that prepares a surface ended with status {process.exitcode}; if memory "
            "was short, give phi.processes=1",
            kind="failed_process",
            key="phi.processes",
        )
        answer = _FAILED, reason
    receiver.close()
    process.join()
    return answer


def _stop(processes: Sequence[BaseProcess], how: signal.Signals) -> None:
    begun = [process for process in processes if process.pid is not None]
    for process in begun:
        with suppress(ProcessLookupError):
            os.kill(cast(int, process.pid), how)
    for process in begun:
        process.join(_PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()
