"""Attributes from files, carried over by a map."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.results import SurfaceMap, atomic_write, on_cut_mesh
from nsm.surfaces import Surface


def read_attributes(
    settings: dict[str, Any], source: Surface, target: Surface
) -> dict[str, np.ndarray]:
    """The arrays of ``attributes.source`` and ``attributes.target``, by these words.

    Each is a .npy file with a row for each vertex of its mesh file.

    Raises:
        NsmError: a file that is no such array.
    """
    result = {}
    for key, surface in (("source", source), ("target", target)):
        if settings[key] is None:
            continue
        try:
            # mapped, so that a header that lies about the size makes no room for it
            values = np.load(settings[key], mmap_mode="r", allow_pickle=False)
            if not isinstance(values, np.ndarray):
                raise ValueError("an archive of arrays")
            on_cut_mesh(surface, values)
        except (OSError, ValueError, EOFError, OverflowError, SyntaxError) as error:
            reason = " ".join(str(error).split())[:160]
            raise NsmError(
                f"attributes.{key}={settings[key]}: {reason}; give a .npy array with a row for "
                "each vertex"
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
