"""A job of a sweep, run wherever the launcher has put it."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf

from nsm.config_validation import checked
from nsm.errors import NsmError
from nsm.pipeline.folder_lock import folder_lock
from nsm.pipeline.runner import run_task
from nsm.pipeline.training import CONFIG_FILE, Run
from nsm.plugins import import_here
from nsm.sweeps import is_complete

Result = TypeVar("Result")

ERROR_FILE, LOG_FILE = "error.txt", "log.txt"


def run_job(settings: dict[str, Any], folder: str, cwd: str, *, log: bool) -> str | None:
    """Run a job in its folder, or go on with it from its checkpoint.

    A failure concerns this job alone: it is written to ``error.txt`` in the folder.

    Args:
        settings: the whole configuration, as plain dictionaries and lists.
        folder: the run folder.
        cwd: the folder that relative paths in the settings start from.
        log: write what is printed to ``log.txt`` in the folder, not to the terminal.

    Returns:
        Why the job failed, in one line, or None.
    """
    os.chdir(cwd)
    import_here()
    place = Path(folder)

    def work() -> None:
        if not is_complete(place):  # another sweep may have been at it
            run = job_run(settings, place)
            run_task(run.config, place, resuming=run.resuming)

    try:
        with folder_lock(place), _output(place / LOG_FILE if log else None):
            (place / ERROR_FILE).unlink(missing_ok=True)
            return attempted(place, work)[1]
    except NsmError as error:  # another process is at work on it
        return str(error)


def job_run(settings: dict[str, Any], place: Path) -> Run:
    """A job as a run, which goes on from the checkpoint in its folder, if there is one.

    Raises:
        NsmError: settings that cannot be used.
    """
    # the folder is named by the settings: those of an earlier sweep are the same
    return Run(checked(OmegaConf.create(settings)), place, (place / CONFIG_FILE).is_file())


def attempted(place: Path, work: Callable[[], Result]) -> tuple[Result | None, str | None]:
    """Do a job's work in its folder: the result, and why it failed, in one line, which is written
    there as well."""
    try:
        return work(), None
    except NsmError as error:
        message = text = str(error)
    except Exception as error:  # a defect: the other jobs must not suffer
        message = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        text = traceback.format_exc()
    (place / ERROR_FILE).write_text(text.rstrip() + "\n", encoding="utf-8")
    return None, message


@contextmanager
def _output(file: Path | None) -> Iterator[None]:
    if file is None:
        yield
        return
    with (
        file.open("a", encoding="utf-8") as stream,
        redirect_stdout(stream),
        redirect_stderr(stream),
    ):
        yield
