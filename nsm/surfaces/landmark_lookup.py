"""Landmarks of many surfaces: files found by the surfaces' names, and tables."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from nsm.errors import NsmError
from nsm.surfaces.catalogue import has_landmarks
from nsm.surfaces.landmark_files import ENDINGS, text
from nsm.surfaces.landmarks import Landmarks
from nsm.surfaces.loading import error_in

# .txt and .json files beside a mesh may hold anything
_BESIDE = (".vts", ".pinned", ".bary", ".pp")
_NAMES = ("", "name", "landmark")


def files_in(folder: str | Path, names: Sequence[str]) -> list[str]:
    """For each surface the file of its landmarks in a folder, which has its name.

    A mesh of the catalogue without one has its own landmarks, if it comes with some.

    Raises:
        NsmError: ``missing_file``: a surface without one, or ``ambiguous_file``: one with several.
    """
    found = [_found(Path(folder), name, ENDINGS) for name in names]
    return _complete(found, names, f"in {folder}", str(folder))


def files_beside(surfaces: Sequence[object], names: Sequence[str]) -> list[str] | None:
    """For each surface the file of its landmarks beside its mesh file; None if there are none.

    Endings are ``.vts``, ``.pinned``, ``.bary`` and ``.pp``. For a mesh of the catalogue, the
    folder of the first mesh file is searched too.

    Args:
        surfaces: as a user gives them.
        names: of the surfaces.

    Raises:
        NsmError: as :func:`files_in`.
    """
    given = [Path(s) if isinstance(s, (str, Path)) else Path() for s in surfaces]
    folders = [path.parent if path.is_file() else None for path in given]
    first = next((folder for folder in folders if folder is not None), None)
    if first is None:
        return None
    found = [
        _found(folder or first, name, _BESIDE) for folder, name in zip(folders, names, strict=True)
    ]
    if not any(found):
        return None
    return _complete(found, names, "beside the meshes", "landmarks")


def _found(folder: Path, name: str, endings: Sequence[str]) -> str | None:
    files = [file for end in endings if (file := folder / f"{name}{end}").is_file()]
    if len(files) > 1:
        listing = " and ".join(file.name for file in files)
        reason = f"{listing} are both landmarks of {name}; remove one, or list the files"
        raise error_in(folder, "ambiguous_file", reason)
    return str(files[0]) if files else None


def _complete(found: Sequence[str | None], names: Sequence[str], where: str, key: str) -> list[str]:
    files = [
        name if file is None and has_landmarks(name) else file
        for file, name in zip(found, names, strict=True)
    ]
    missing = [name for file, name in zip(files, names, strict=True) if file is None]
    if missing:
        some = next((Path(file).name for file in files if file is not None), None)
        others = (
            f", but {some} is there" if some else f"; name one {missing[0]}.vts or {missing[0]}.pp"
        )
        raise NsmError(
            f"landmarks {where}: none of {', '.join(missing[:5])}{others}; give each surface a "
            "file with its name",
            kind="missing_file",
            key=key,
        )
    return [file for file in files if file is not None]


class Table(NamedTuple):
    """Landmarks of surfaces by their names, and the names of the landmarks, if there are some."""

    columns: dict[str, Landmarks]
    names: list[str] | None


def read_table(path: str | Path) -> Table:
    """Landmarks from a CSV file: a row for each, a column of vertices for each surface.

    The first line has the surfaces' names. A column ``name`` or ``landmark`` has the landmarks'.
    An empty cell, or -1, is a landmark that the surface lacks.

    Raises:
        NsmError: ``damaged_file``, or as :func:`nsm.surfaces.loading.check_file`.
    """
    file = Path(path)
    rows = [row for row in csv.reader(text(file).splitlines()) if any(map(str.strip, row))]
    if len(rows) < 2:
        raise error_in(file, "damaged_file", "give surfaces in the first line, landmarks below")
    heads = [head.strip() for head in rows[0]]
    columns: dict[str, Landmarks] = {}
    names: list[str] | None = None
    for k, head in enumerate(heads):
        cells = [row[k].strip() if k < len(row) else "" for row in rows[1:]]
        if head.lower() in _NAMES:
            names = cells
            continue
        if head in columns:
            raise error_in(file, "damaged_file", f"two columns are called {head}; leave one out")
        numbers: list[int] = []
        for row, cell in enumerate(cells, start=2):
            try:
                numbers.append(int(cell) if cell else -1)
            except ValueError:
                reason = f"line {row}, {head}: {cell[:30]!r} is no vertex number; give one or none"
                raise error_in(file, "damaged_file", reason) from None
        columns[head] = numbers
    return Table(columns, names)
