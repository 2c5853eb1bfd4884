"""Folders that nothing came of."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders, each the one around the one before, up to the first that is not empty."""
    for folder in folders:
        if not folder.is_dir() or any(folder.iterdir()):
            return
        folder.rmdir()
