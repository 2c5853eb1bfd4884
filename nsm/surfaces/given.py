"""A mesh as users have it: a file, a name of the catalogue, arrays, or an object of trimesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.surfaces.catalogue import catalogue_mesh
from nsm.surfaces.loading import as_arrays, check_arrays, load_mesh


@dataclass(frozen=True)
class GivenMesh:
    """A mesh as it was given, before any repair.

    Attributes:
        name: in logs and file names.
        vertices: (W, 3) float64, in the given order: vertex numbers count these from 0; of an OBJ
            file they count its ``v`` lines.
        faces: (G, 3) int64.
        log: a line for each conversion.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    log: tuple[str, ...] = ()


def given_mesh(given: Any, name: str = "mesh") -> GivenMesh:
    """The mesh that a user gives.

    Args:
        given: a mesh file or a name of the catalogue; an object with ``vertices`` and ``faces``, as
            trimesh's, or a scene of trimesh; or a pair of arrays (V, 3) and (F, 3).
        name: of a mesh that has none.

    Raises:
        NsmError: ``wrong_type``: nothing of these; or as :func:`nsm.surfaces.loading.load_mesh`.
    """
    if isinstance(given, (str, Path)):
        text = str(given)
        if Path(text).suffix or "/" in text or "\\" in text or Path(text).exists():
            return GivenMesh(Path(text).stem, *load_mesh(given))
        return GivenMesh(text, *catalogue_mesh(text))
    log: tuple[str, ...] = ()
    file = _file_of(given)
    if hasattr(given, "to_mesh"):  # a scene of trimesh, as it reads GLB files
        given = given.to_mesh()
    if hasattr(given, "vertices") and hasattr(given, "faces"):
        vertices, faces = given.vertices, given.faces
        if file is not None:
            name, log = file.stem, _other_numbers(file, np.asarray(vertices))
    elif isinstance(given, (tuple, list)) and len(given) == 2:
        vertices, faces = (x.detach().cpu() if hasattr(x, "detach") else x for x in given)
    else:
        raise no_mesh(f"a {type(given).__name__}", name)
    vertices, faces = as_arrays(vertices, faces, name)
    check_arrays(vertices, faces, name)
    return GivenMesh(name, vertices, faces, log)


def no_mesh(what: str, name: str) -> NsmError:
    """The error of what was given in place of a mesh."""
    return NsmError(
        f"{name}: {what} is no mesh; give a file, a catalogue name, an object of trimesh or a pair "
        "(vertices, faces)",
        kind="wrong_type",
        key=name,
    )


def _file_of(mesh: Any) -> Path | None:
    """The file that an object of trimesh was read from, if it is still there."""
    path = getattr(getattr(mesh, "source", None), "file_path", None)
    path = path or (getattr(mesh, "metadata", None) or {}).get("file_path")
    return Path(path) if path and Path(path).is_file() else None


def _other_numbers(file: Path, vertices: np.ndarray) -> tuple[str, ...]:
    """A warning where vertex numbers of an object are not those of its file."""
    try:
        own = load_mesh(file)[0]
    except NsmError:
        return ()
    if own.shape == vertices.shape and np.allclose(own, vertices):
        return ()
    return (
        f"warning: vertex numbers are those of the trimesh object ({len(vertices)} vertices), not "
        f"of {file.name} ({len(own)}); load it with process=False and maintain_order=True, or give "
        "the file",
    )
