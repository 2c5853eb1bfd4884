"""Which surfaces a collection consists of: lists, patterns of files, and a template."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nsm.errors import NsmError
from nsm.results.artifact import is_stored_surface
from nsm.surfaces.loading import EXTENSIONS

LEAST = 3


def collected(given: Any, template: Any = None) -> list[Any]:
    """The surfaces of a collection, the template first.

    Args:
        given: surfaces; or a pattern of files, such as ``scans/*.ply``, also among others. Its
            meshes and run folders come in alphabetical order, without the template.
        template: a surface.

    Raises:
        NsmError: ``out_of_range``: fewer than three surfaces; ``missing_file``: a pattern that
            nothing matches.
    """
    items = [given] if isinstance(given, (str, Path)) else given
    if not isinstance(items, Sequence):
        items = []
    found = [one for item in items for one in _matches(item)]
    if template is not None:
        found = [template, *(one for one in found if not _same(one, template))]
    if len(found) < LEAST:
        instead = "; for two, take task=pair_map" if len(found) == 2 else ""
        counted = f"{len(found)} with the template" if template is not None else str(len(found))
        raise NsmError(
            f"setting surfaces: a collection needs a list of three surfaces or more, or a pattern "
            f"of files; there are {counted}{instead}",
            kind="out_of_range",
            key="surfaces",
        )
    return found


def _matches(item: Any) -> list[Any]:
    """The files of a pattern; anything else as it is."""
    if not isinstance(item, (str, Path)) or os.path.exists(item) or not glob.has_magic(str(item)):
        return [item]
    pattern = os.path.expanduser(item)
    found = [
        path
        for path in sorted(glob.glob(pattern))
        if Path(path).suffix.lower() in EXTENSIONS or is_stored_surface(path)
    ]
    if not found:
        place = Path(pattern).parent
        where = f"in {place.resolve()}" if place.is_dir() else f"as there is no folder {place}"
        raise NsmError(
            f"surfaces={item}: no mesh file matches, {where}; check the pattern",
            kind="missing_file",
            key="surfaces",
        )
    return found


def _same(one: Any, other: Any) -> bool:
    """Whether two inputs are one object or one file."""
    if not all(isinstance(x, (str, Path)) for x in (one, other)):
        return one is other
    return os.path.realpath(one) == os.path.realpath(other)
