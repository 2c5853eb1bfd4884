"""Folders that nothing came of, and such as pass away."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

_PASSING = "nsm-passing-"


def passing_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder for a run of which nothing is kept."""
    return tempfile.TemporaryDirectory(prefix=_PASSING)


def is_passing(folder: Path) -> bool:
    """Whether a folder is one of :func:`passing_folder`: no use to name it."""
    return folder.name.startswith(_PASSING)


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders, each the one around the one before, up to the first that is not empty."""
    for folder in folders:
        if not folder.is_dir() or any(folder.iterdir()):
            return
        folder.rmdir()
