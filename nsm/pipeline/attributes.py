"""Attributes from files, carried over by a map."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.results import SurfaceMap, atomic_write


def transfer_attributes(settings: dict[str, Any], folder: Path, f: SurfaceMap) -> None:
    """Carry over the arrays of ``attributes.source`` and ``attributes.target``.

    Each is a .npy file with a row for each vertex of its mesh file; the result lies in the folder
    as ``NAME_on_target.npy`` or ``NAME_on_source.npy``.

    Raises:
        NsmError: a file that is no such array.
    """
    for key, back, end in (("source", False, "target"), ("target", True, "source")):
        if settings[key] is None:
            continue
        file = Path(settings[key])
        try:
            moved = f.transfer(np.load(file, allow_pickle=False), back=back)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())[:160]
            raise NsmError(
                f"attributes.{key}={file}: {reason}; give a .npy array with a row for each vertex"
            ) from error
        data = io.BytesIO()
        np.save(data, moved)
        atomic_write(folder / f"{file.stem}_on_{end}.npy", data.getvalue())
