"""What is fuzzed: functions of bytes that may raise NsmError alone."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from nsm.config import read_config
from nsm.errors import NsmError
from nsm.results import load_collection, load_parameterization, load_surface, load_surface_map
from nsm.surfaces.landmarks import read_landmarks, read_pairs
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.validation import clean

MESHES = ("obj", "off", "ply", "stl", "gltf", "glb")


def _in_file(name: str, read: Callable[[Path], object], data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_bytes(data)
        with contextlib.suppress(NsmError), contextlib.redirect_stderr(io.StringIO()):
            read(file)


def _mesh(file: Path) -> None:
    vertices, faces, _ = load_mesh(file)
    assert np.isfinite(vertices).all() and 0 <= faces.min() <= faces.max() < len(vertices)
    cleaned = clean(vertices, faces)
    assert np.isfinite(cleaned.vertices).all() and len(cleaned.faces)


def _artefact(stem: str, read: Callable[[Path], object], data: bytes) -> None:
    """The first line is the JSON, with the checksum of the rest, which are the arrays."""
    import hashlib

    words, _, arrays = data.partition(b"\n")
    words = words.replace(b"SHA256", hashlib.sha256(arrays).hexdigest().encode())
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / f"{stem}.json").write_bytes(words)
        (Path(folder) / f"{stem}.safetensors").write_bytes(arrays)
        with contextlib.suppress(NsmError):
            read(Path(folder))


TARGETS: dict[str, Callable[[bytes], None]] = {
    **{kind: partial(_in_file, f"mesh.{kind}", _mesh) for kind in MESHES},
    "config": partial(_in_file, "config.yaml", read_config),
    "pairs": partial(_in_file, "pairs.json", read_pairs),
    "landmarks": partial(_in_file, "landmarks.vts", read_landmarks),
    "surface": partial(_artefact, "surface", load_surface),
    "map": partial(_artefact, "map", load_parameterization),
    "pair": partial(_artefact, "pair", load_surface_map),
    "collection": partial(_artefact, "collection", load_collection),
}
