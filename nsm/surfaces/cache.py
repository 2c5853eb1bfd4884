"""Prepared surfaces on disk, keyed by content, so that each mesh is cut and flattened once."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

# Increase it when the preparation changes: entries of older versions are then ignored.
PREPARATION_VERSION = 9


def downloads() -> ModuleType:
    """pooch, imported when needed, without tqdm's advice to notebooks on bars that it never draws
    here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pooch
    return pooch


def cache_folder() -> Path:
    """The folder of prepared surfaces and downloaded meshes: ``NSM_CACHE``, or the user's cache."""
    return Path(os.environ.get("NSM_CACHE") or downloads().os_cache("nsm"))


def preparation_key(vertices: np.ndarray, faces: np.ndarray, options: Mapping[str, Any]) -> str:
    """Hash of a mesh (V, 3), (F, 3), of the preparation's options and of its version."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(faces, dtype="<i8").tobytes())
    digest.update(json.dumps([PREPARATION_VERSION, dict(options)], sort_keys=True).encode())
    return digest.hexdigest()[:32]


def read(key: str) -> dict[str, np.ndarray] | None:
    """The arrays stored under a key, or None. A damaged entry is removed."""
    path = cache_folder() / "surfaces" / f"{key}.npz"
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except Exception:  # a damaged archive raises any exception; the surface is prepared again
        path.unlink(missing_ok=True)
        return None


def write(key: str, arrays: Mapping[str, np.ndarray]) -> None:
    """Store arrays under a key. If the cache cannot be written, nothing is stored."""
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
