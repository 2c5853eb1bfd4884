"""Attributes from files, carried over by a map."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.results import SurfaceMap, atomic_write
from nsm.results.points import as_values
from nsm.wording import number_of


def read_attributes(settings: dict[str, Any], rows: Sequence[int]) -> dict[str, np.ndarray]:
    """The arrays of ``attributes.source`` and ``attributes.target``, under these keys.

    Each is a .npy file with a row for each vertex of its mesh file.

    Args:
        settings: the group ``attributes``.
        rows: how many vertices the two mesh files have.

    Raises:
        NsmError: a file that is not such an array.
    """
    result = {}
    for key, count in zip(("source", "target"), rows, strict=True):
        if settings[key] is None:
            continue
        try:
            if not Path(settings[key]).is_file():  # reading a pipe would block
                raise ValueError("no such file")
            # memory-mapped: a header with a false size allocates nothing
            values = np.load(settings[key], mmap_mode="r", allow_pickle=False)
            if not isinstance(values, np.ndarray):
                raise ValueError("an archive of arrays")
            as_values(values, "its values")
            if values.ndim == 0 or len(values) < count:
                given = values.shape[0] if values.ndim else 0
                raise ValueError(f"{number_of(given, 'row')}, but the mesh has {count} vertices")
        except (OSError, ValueError, EOFError, OverflowError, SyntaxError, NsmError) as error:
            reason = " ".join(str(error).split())[:160]
            raise NsmError(
                f"attributes.{key}={settings[key]}: {reason}; give a .npy array with a row for "
                "each vertex",
                kind="unreadable_file",
                key=f"attributes.{key}",
            ) from error
        result[key] = values
    return result


def write_transferred(
    attributes: dict[str, np.ndarray], settings: dict[str, Any], folder: Path, f: SurfaceMap
) -> None:
    """Carry the arrays over, into NAME_on_target.npy and NAME_on_source.npy in the folder."""
    for key, values in attributes.items():
        end = "target" if key == "source" else "source"
        data = io.BytesIO()
        np.save(data, f.transfer(values, back=key == "target"))
        atomic_write(folder / f"{Path(settings[key]).stem}_on_{end}.npy", data.getvalue())
