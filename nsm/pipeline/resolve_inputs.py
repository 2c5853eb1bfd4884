"""From the words that name surfaces and landmarks to neural surfaces with matched landmarks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Surface
from nsm.domains.joint_preparation import Mesh, prepare_jointly
from nsm.errors import NsmError
from nsm.maps import ANALYTIC
from nsm.pipeline.common import accelerator_of, report_surface
from nsm.pipeline.surface_cache import made_batched
from nsm.results import NeuralSurface, analytic_surface, load_surface
from nsm.surfaces.catalogue import catalogue_mesh
from nsm.surfaces.landmarks import (
    Landmarks,
    as_lists,
    as_vertices,
    check_equal_lengths,
    listed,
    read_collection,
    read_landmarks,
    read_pairs,
)
from nsm.surfaces.loading import load_mesh

Shape = NeuralSurface | Mesh


def read_shape(given: Any, domain: str, key: str) -> Shape:
    """What a user calls a surface.

    Args:
        given: a NeuralSurface; the folder of one; a mesh file; a name of the catalogue; or an
            analytic surface, as ``{"name": ..., parameters}`` or, for a target, by its name.
        domain: ``disc`` or ``square``.
        key: the setting's name, for messages.

    Raises:
        NsmError: nothing of these, or one that cannot be read or lies on the other domain.
    """
    if given is None:
        raise NsmError(f"setting {key}: give a mesh file, a catalogue name or a run folder")
    if isinstance(given, dict):
        return analytic_surface(given, domain)
    if not isinstance(given, (NeuralSurface, str, Path)):
        raise NsmError(
            f"setting {key}: a {type(given).__name__} is no surface; give a neural surface, a mesh "
            "file, a catalogue name or a run folder"
        )
    if isinstance(given, NeuralSurface):
        ready = given
    else:
        word = str(given)
        if (Path(word) / "surface.json").exists() or word.endswith("surface.safetensors"):
            ready = load_surface(word)
        elif word in ANALYTIC and key == "target":  # some are also meshes of the catalogue
            return analytic_surface({"name": word}, domain)
        elif Path(word).suffix or os.sep in word or Path(word).exists():
            vertices, faces, log = load_mesh(word)
            return Mesh(Path(word).stem, vertices, faces, tuple(log))
        else:
            return Mesh(word, *catalogue_mesh(word))
    if str(ready.surface.domain) != domain:
        raise NsmError(
            f"{key}={ready.surface.name}: it lies on the {ready.surface.domain}, but domain="
            f"{domain}; all surfaces of a map need one domain"
        )
    return ready


def vertex_count(shape: Shape) -> int:
    """How many vertices the mesh file of a shape has."""
    return len(shape.vertices if isinstance(shape, Mesh) else shape.surface.cut_vertex)


def landmark_vertices(given: Any, shapes: Sequence[Shape]) -> list[np.ndarray]:
    """Landmarks as vertices (L,) of each shape's mesh file.

    Args:
        given: None; a JSON file; one file, or one list of vertices or points, per shape; or, for
            two shapes, a list of pairs.
        shapes: two or more.

    Raises:
        NsmError: a file that cannot be read, a landmark that is not on its shape, or given twice,
            or lists of different lengths.
    """
    names = [_name(shape) for shape in shapes]
    lists = [
        listed(item, f"landmarks of {name}")
        for item, name in zip(_lists(given, len(shapes)), names, strict=True)
    ]
    check_equal_lengths(names, lists)
    return [_vertices(list_, shape) for list_, shape in zip(lists, shapes, strict=True)]


def _lists(given: Any, count: int) -> list[Any]:
    if given is None:
        return [[] for _ in range(count)]
    if isinstance(given, (str, Path)):
        lists = list(read_pairs(given)) if count == 2 else read_collection(given)
    elif isinstance(given, dict):
        try:
            lists = [given["source"], given["target"]]
        except KeyError as error:
            raise NsmError(f"landmarks: {error} is missing beside the other list") from None
    else:
        lists = as_lists(given)
        if not isinstance(lists, list):
            raise NsmError("landmarks: neither lists of landmarks nor files")
        if count == 2 and lists and all(_is_pair(item) for item in lists):
            lists = [[pair[0] for pair in lists], [pair[1] for pair in lists]]
        lists = [read_landmarks(x) if isinstance(x, (str, Path)) else x for x in lists]
    if not lists:  # as good as None
        return [[] for _ in range(count)]
    if len(lists) != count:
        raise NsmError(f"landmarks: {len(lists)} lists for {count} surfaces; give one for each")
    return lists


def _is_pair(item: Any) -> bool:
    """Whether an entry is a pair of landmarks, as against a whole list of one surface's.

    Two lists of two vertices each would look the same; as two pairs they say more often what is
    meant, as pairs are what the documentation shows.
    """
    return isinstance(item, list) and len(item) == 2


def _name(shape: Shape) -> str:
    return shape.name if isinstance(shape, Mesh) else shape.surface.name


def _vertices(given: Landmarks, shape: Shape) -> np.ndarray:
    if len(given) == 0:
        return np.zeros(0, dtype=np.int64)
    if isinstance(shape, Mesh):
        return as_vertices(given, shape.vertices, shape.name)
    surface = shape.surface
    if isinstance(given, list):
        surface.preimages(given)  # tells which one is not there
        as_vertices(surface.cut_vertex[given], surface.vertices, surface.name)
        return np.asarray(given, dtype=np.int64)
    known = np.flatnonzero(surface.source_vertex >= 0)
    points = shape.in_original_units(surface.vertices[known])
    return surface.source_vertex[known[as_vertices(given, points, surface.name)]]


def neural_surfaces(
    config: DictConfig, shapes: Sequence[Shape], landmarks: Sequence[np.ndarray], console: Console
) -> list[NeuralSurface]:
    """Neural surfaces of the shapes; those that are meshes are prepared together, and overfitted.

    Raises:
        NsmError: a mesh that cannot be prepared.
    """
    meshes = [(k, s) for k, s in enumerate(shapes) if isinstance(s, Mesh)]
    result: list[NeuralSurface | None] = [None if isinstance(s, Mesh) else s for s in shapes]
    if meshes:
        prepared = _prepare(config, meshes, landmarks)
        for surface in prepared:
            report_surface(console, surface)
        made = made_batched(prepared, config, console, in_one_batch=accelerator_of(config) == "gpu")
        for (k, _), phi in zip(meshes, made, strict=True):
            result[k] = phi
    return [r for r in result if r is not None]


def _prepare(
    config: DictConfig, meshes: Sequence[tuple[int, Mesh]], landmarks: Sequence[np.ndarray]
) -> list[Surface]:
    settings = config.surface
    return prepare_jointly(
        [mesh for _, mesh in meshes],
        [landmarks[k] if len(meshes) > 1 else np.zeros(0, np.int64) for k, _ in meshes],
        domain=config.domain,
        parameterization=settings.parameterization,
        seam=config.seam.path,
        seam_landmarks=config.seam.landmarks,
        cache=settings.cache,
    )
