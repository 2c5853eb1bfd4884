"""Prepared surfaces kept on disk, keyed by content, so that a mesh is cut and flattened once."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

# Raise it when the preparation changes, so that no older result is taken for a new one.
PREPARATION_VERSION = 6


def cache_folder() -> Path:
    """Where prepared surfaces and fetched meshes are kept: ``NSM_CACHE``, else the user's cache."""
    import pooch

    return Path(os.environ.get("NSM_CACHE") or pooch.os_cache("nsm"))


def preparation_key(vertices: np.ndarray, faces: np.ndarray, options: Mapping[str, Any]) -> str:
    """Hash of the mesh, of how it is to be prepared, and of the preparation's version."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(faces, dtype="<i8").tobytes())
    digest.update(json.dumps([PREPARATION_VERSION, dict(options)], sort_keys=True).encode())
    return digest.hexdigest()[:32]


def read(key: str) -> dict[str, np.ndarray] | None:
    """The arrays stored under a key, or None; a damaged entry counts as none and is removed."""
    path = cache_folder() / "surfaces" / f"{key}.npz"
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except Exception:  # whatever a damaged archive raises, the surface can be made again
        path.unlink(missing_ok=True)
        return None


def write(key: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Store arrays under a key; a cache that cannot be written is no reason to stop the work."""
    folder = cache_folder() / "surfaces"
    temporary: str | None = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".tmp", delete=False) as stream:
            temporary = stream.name
            np.savez_compressed(stream, allow_pickle=False, **dict(arrays))
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, folder / f"{key}.npz")
    except OSError:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
