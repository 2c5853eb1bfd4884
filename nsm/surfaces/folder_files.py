"""Files that a mesh file names: read only from its folder and the folders below."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import unquote


def read_below(folder: Path, name: str) -> bytes:
    """The contents of a file that a mesh file in a folder names.

    Raises:
        ValueError: the file is outside the folder, or not a regular file.
    """
    root = folder.resolve()
    file = (root / unquote(name)).resolve()
    if not file.is_relative_to(root):
        raise ValueError(f"it refers to {name!r}, outside its folder")
    if not file.is_file():
        raise ValueError(f"it refers to the missing file {name!r}")
    return file.read_bytes()
