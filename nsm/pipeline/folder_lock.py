"""One run in a folder at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from nsm.errors import NsmError
from nsm.run_directories import remove_empty

LOCK_FILE = ".lock"


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Lock a run folder, which is made if need be, and removed if nothing was written into it.

    The operating system releases the lock when the process ends, however that happens.

    Raises:
        NsmError: another process holds it.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK_FILE, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise NsmError(
            f"{folder}: another run is at work there; wait for its end, or give another folder",
            kind="folder_in_use",
            key=str(folder),
        ) from None
    try:
        yield
    finally:
        lock.release(force=True)
        if [entry.name for entry in folder.iterdir()] == [LOCK_FILE]:
            (folder / LOCK_FILE).unlink(missing_ok=True)
            remove_empty(made)
