"""Temporary run folders, and empty ones."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

_PREFIX = "nsm-run-"


def temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """A temporary folder for a run of which nothing is kept."""
    return tempfile.TemporaryDirectory(prefix=_PREFIX)


def is_temporary(folder: Path) -> bool:
    """Whether a folder is one of :func:`temporary_folder`, which messages need not name."""
    return folder.name.startswith(_PREFIX)


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders, each the parent of the one before, up to the first that is not empty."""
    for folder in folders:
        if not folder.is_dir() or any(folder.iterdir()):
            return
        folder.rmdir()
