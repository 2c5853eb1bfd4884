"""A job of a sweep, run wherever the launcher has put it."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf

from nsm.config import checked, register_resolvers
from nsm.errors import NsmError
from nsm.pipeline import run_held
from nsm.pipeline.common import CONFIG_FILE
from nsm.pipeline.folder_lock import folder_lock
from nsm.sweeps import is_complete

Result = TypeVar("Result")

ERROR_FILE, LOG_FILE = "error.txt", "log.txt"


def run_job(settings: dict[str, Any], folder: str, cwd: str, *, log: bool) -> str | None:
    """Run a job in its folder, or go on with it from its checkpoint.

    Whatever goes wrong concerns this job alone: it is written to ``error.txt`` in the folder.

    Args:
        settings: the whole configuration, as plain dictionaries and lists.
        folder: the run folder.
        cwd: the folder that relative paths in the settings are meant from.
        log: write what is printed to ``log.txt`` in the folder, not to the terminal.

    Returns:
        Why the job failed, in one line, or None.
    """
    os.chdir(cwd)
    register_resolvers()
    place = Path(folder)

    def run() -> None:
        if not is_complete(place):  # another sweep may have been at it
            run_held(job_config(settings, place), place)

    try:
        with folder_lock(place), _output(place / LOG_FILE if log else None):
            (place / ERROR_FILE).unlink(missing_ok=True)
            return attempted(place, run)[1]
    except NsmError as error:  # another process is at work on it
        return str(error)


def job_config(settings: dict[str, Any], place: Path) -> DictConfig:
    """The configuration of a job, which goes on with what is in its folder.

    Raises:
        NsmError: settings that cannot be used.
    """
    config = checked(OmegaConf.create(settings))
    if (place / CONFIG_FILE).is_file():
        config.resume = str(place)
    return config


def attempted(place: Path, work: Callable[[], Result]) -> tuple[Result | None, str | None]:
    """Do a job's work in its folder: the result, and why it failed, in one line, which is written
    there as well."""
    try:
        return work(), None
    except NsmError as error:
        message = text = str(error)
    except Exception as error:  # a defect of nsm: the other jobs shall not suffer
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
