"""The shapes of a run for the 3D views, and the distortion of its triangles."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nsm.errors import NsmError
from nsm.results.artifact import load_surface
from nsm.results.collection import load_collection
from nsm.results.metrics import evaluate, vertex_error
from nsm.results.pair_metrics import ENERGIES, triangle_energies
from nsm.results.parameterization import load_parameterization
from nsm.results.render import UP_AXES, frames_of
from nsm.results.report.runs import short
from nsm.results.stored_map import load_surface_map
from nsm.results.surface_map import SurfaceMap
from nsm.surfaces.geometry import decimate
from nsm.surfaces.topology import face_areas

_FACES = 50_000  # at most, per shape; finer meshes are decimated for the page


@dataclass(frozen=True)
class Shape:
    """A mesh (V, 3), (F, 3) to display, with values (V,) or (F,) to colour it by.

    ``frames`` are rows right, up and towards the viewer (3, 3) by the axis that points up.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    colours: dict[str, np.ndarray]
    frames: dict[str, np.ndarray]


@dataclass(frozen=True)
class Distortion:
    """The energies (F,) of triangles by name, and their areas (F,) on the source."""

    values: dict[str, np.ndarray]
    areas: np.ndarray


_Read = tuple[list[Shape], Distortion]


def read_shapes(
    task: str, folder: Path, trust: Sequence[str] = ()
) -> tuple[list[Shape], Distortion]:
    """The shapes of a run, and the distortion of its map on the triangles of the mesh.

    The map of ``overfit`` is from the mesh to φ; the distortion of a collection is that of all
    pairs together.

    Args:
        task: of the run.
        folder: of the run.
        trust: modules outside nsm whose code the files may name.

    Raises:
        NsmError: ``no_shapes``, ``damaged_file``, or as the loaders.
    """
    if task not in _READERS:
        raise NsmError(f"task {task} has no shapes", kind="no_shapes", key=task)
    try:
        return _READERS[task](folder, trust)
    except (ValueError, IndexError, RuntimeError) as error:  # arrays that do not fit together
        reason = f"not readable: {short(error)}"
        raise NsmError(reason, kind="damaged_file", key=str(folder)) from error


def _overfit(folder: Path, trust: Sequence[str]) -> _Read:
    neural = load_surface(folder, trust=trust)
    surface = neural.surface
    vertices, faces = evaluate(neural.map, surface.uv), surface.faces
    distortion = _measured(surface.vertices, vertices, faces)
    colours = {
        "distance, % of diagonal": vertex_error(surface, neural.map),
        "normal error, degrees": _face_angles(vertices, surface.vertices, faces),
        **distortion.values,
    }
    frames = frames_of(surface.vertices)
    shapes = [
        _shape("neural surface", vertices, faces, colours, frames),
        _shape("source mesh", surface.vertices, faces, {}, frames),
    ]
    return shapes, distortion


def _param(folder: Path, trust: Sequence[str]) -> _Read:
    result = load_parameterization(folder, trust=trust)
    surface, uv = result.phi.surface, result.uv
    flat = np.column_stack([uv, np.zeros(len(uv))])
    distortion = _measured(surface.vertices, flat, surface.faces)
    shapes = [
        _shape(
            "flattened", flat, surface.faces, distortion.values, dict.fromkeys(UP_AXES, np.eye(3))
        ),
        _shape("surface", surface.vertices, surface.faces, distortion.values),
    ]
    return shapes, distortion


def _pair_map(folder: Path, trust: Sequence[str]) -> _Read:
    f = load_surface_map(folder, trust=trust)
    image, source, distortion = _both_ends(f)
    return [image("mapped onto the target"), source("source")], distortion


def _collection_map(folder: Path, trust: Sequence[str]) -> _Read:
    collection = load_collection(folder, trust=trust)
    shapes, parts = [], []
    for i, j in itertools.permutations(range(len(collection)), 2):
        f = collection.pair(i, j)
        image, source, distortion = _both_ends(f)
        names = f.source.surface.name, f.target.surface.name
        shapes.append(image(f"{names[0]} → {names[1]}"))
        if j == (i + 1) % len(collection):
            shapes.append(source(names[0]))
        parts.append(distortion)
    values = {name: np.concatenate([part.values[name] for part in parts]) for name in _NAMES}
    return shapes, Distortion(values, np.concatenate([part.areas for part in parts]))


_READERS: dict[str, Callable[[Path, Sequence[str]], _Read]] = {
    "overfit": _overfit,
    "param": _param,
    "pair_map": _pair_map,
    "collection_map": _collection_map,
}
_NAMES = [energy.__name__.replace("_", " ") for energy in ENERGIES]


def _both_ends(
    f: SurfaceMap,
) -> tuple[Callable[[str], Shape], Callable[[str], Shape], Distortion]:
    """Functions from a name to the image and to the source, and the map's distortion."""
    f = f.part
    surface = f.source.surface
    distortion = _measured(surface.vertices, f.image, surface.faces)
    # a point and its image get the same colour, which shows the correspondence
    positions = {f"{axis} on the source": surface.vertices[:, k] for k, axis in enumerate("xyz")}
    colours = {**distortion.values, **positions}
    frames = frames_of(f.target.surface.vertices)

    def image(name: str) -> Shape:
        return _shape(name, f.image, surface.faces, colours, frames)

    def source(name: str) -> Shape:
        return _shape(name, surface.vertices, surface.faces, colours)

    return image, source, distortion


def _measured(source: np.ndarray, image: np.ndarray, faces: np.ndarray) -> Distortion:
    energies = triangle_energies(source, image, faces)
    return Distortion(dict(zip(_NAMES, energies.values(), strict=True)), face_areas(source, faces))


def _face_angles(vertices: np.ndarray, reference: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Angles (F,) in degrees between the normals of the same faces of two meshes."""
    a, b = (
        np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]])
        for p in (vertices, reference)
    )
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.degrees(np.arctan2(sine, (a * b).sum(axis=1)))


def _shape(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    colours: dict[str, np.ndarray],
    frames: dict[str, np.ndarray] | None = None,
) -> Shape:
    if frames is None:
        frames = frames_of(vertices)
    if len(faces) <= _FACES:
        return Shape(name, vertices, faces, colours, frames)
    kept, coarse, parent = decimate(vertices, faces, _FACES)
    decimated = {
        key: values[kept] if len(values) == len(vertices) else values[parent]
        for key, values in colours.items()
    }
    return Shape(name, vertices[kept], coarse, decimated, frames)
