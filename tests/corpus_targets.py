"""Fuzz targets: functions of bytes that may raise no exception but NsmError, and their seeds."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from tiny import Results, results

import nsm
from nsm.config import read_config
from nsm.errors import NsmError
from nsm.pipeline.checkpoints import stored_state
from nsm.surfaces.landmark_files import read_landmarks, read_pairs
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.validation import clean

MESHES = ("obj", "off", "ply", "stl", "gltf", "glb")
ARTEFACTS = ("surface", "map", "pair", "collection")


def _in_file(name: str, read: Callable[[Path], object], data: bytes) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_bytes(data)
        with contextlib.suppress(NsmError), contextlib.redirect_stderr(io.StringIO()):
            read(file)
            return True
    return False


def _mesh(file: Path) -> None:
    vertices, faces, _ = load_mesh(file)
    assert np.isfinite(vertices).all() and 0 <= faces.min() <= faces.max() < len(vertices)
    cleaned = clean(vertices, faces)
    assert np.isfinite(cleaned.vertices).all() and len(cleaned.faces)


@cache
def _tiny() -> Results:
    return results(rings=1)


def _saved(stem: str, folder: Path) -> None:
    tiny = _tiny()
    {"surface": tiny.neural[0], "map": tiny.flat, "pair": tiny.pair, "collection": tiny.trio}[
        stem
    ].save(folder)


def _artefact(stem: str, data: bytes) -> bool:
    """Load and use a saved result; the first line of the data is its JSON, the rest its arrays.

    ``SHA256`` in the JSON is replaced by the checksum of the arrays. The other files are valid.
    """
    metadata, _, arrays = data.partition(b"\n")
    metadata = metadata.replace(b"SHA256", hashlib.sha256(arrays).hexdigest().encode())
    with tempfile.TemporaryDirectory() as name, contextlib.suppress(NsmError):
        folder = Path(name)
        _saved(stem, folder)
        (folder / f"{stem}.json").write_bytes(metadata)
        (folder / f"{stem}.safetensors").write_bytes(arrays)
        thing = nsm.load(folder)
        points = np.array([[0.1, 0.2], [-0.5, 0.3]])
        if isinstance(thing, nsm.SurfaceCollection):
            thing = thing.pair(0, 1)
        if isinstance(thing, nsm.SurfaceMap):
            thing(np.pad(points, ((0, 0), (0, 1))))
            thing.planar(points)
        else:
            thing(points)
        return True
    return False


def seeds(name: str) -> list[bytes]:
    """Valid input for a target that reads files of nsm."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        if name == "checkpoint":
            state = {"weight": torch.zeros(2, 3), "bias": torch.nn.Parameter(torch.ones(2))}
            torch.save({"global_step": 7, "state_dict": state}, folder / "last.ckpt")
            return [(folder / "last.ckpt").read_bytes()]
        if name not in ARTEFACTS:
            return []
        _saved(name, folder)
        metadata = json.loads((folder / f"{name}.json").read_text())
        line = json.dumps({**metadata, "sha256": "SHA256"}, separators=(",", ":")).encode()
        return [line + b"\n" + (folder / f"{name}.safetensors").read_bytes()]


# functions of bytes to whether they were accepted; any exception is a finding
TARGETS: dict[str, Callable[[bytes], bool]] = {
    **{kind: partial(_in_file, f"mesh.{kind}", _mesh) for kind in MESHES},
    "config": partial(_in_file, "config.yaml", read_config),
    "pairs": partial(_in_file, "pairs.json", read_pairs),
    "landmarks": partial(_in_file, "landmarks.vts", read_landmarks),
    "picked": partial(_in_file, "landmarks.pp", read_landmarks),
    "barycentric": partial(_in_file, "landmarks.bary", read_landmarks),
    "checkpoint": partial(_in_file, "last.ckpt", stored_state),
    **{stem: partial(_artefact, stem) for stem in ARTEFACTS},
}
