"""From settings that name surfaces and landmarks to neural surfaces and vertices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Domain, Surface, domain
from nsm.domains.joint_preparation import (
    Mesh,
    check_common_topology,
    matched_landmarks,
    prepare_jointly,
)
from nsm.errors import NsmError
from nsm.maps import ANALYTIC, AnalyticSurface
from nsm.pipeline.configured_surface import configured_repairs, report_surface
from nsm.pipeline.surface_cache import cached_surfaces
from nsm.results import NeuralSurface, analytic_surface, load_surface
from nsm.results.analytic import lies_over
from nsm.results.artifact import is_stored_surface
from nsm.stages import stage
from nsm.surfaces.catalogue import (
    catalogue_landmarks,
    catalogue_names,
    has_landmarks,
)
from nsm.surfaces.given import given_mesh
from nsm.surfaces.landmark_files import Marks, read_collection, read_marks, read_pairs
from nsm.surfaces.landmarks import (
    AtVertices,
    Landmarks,
    as_lists,
    as_vertices,
    check_equal_lengths,
    listed,
)

Shape = NeuralSurface | Mesh
_MOVED = 1e-4  # percent of the diagonal: less is the rounding of a file's digits


def read_shape(given: Any, domain: Domain, key: str, trust: Iterable[str] = ()) -> Shape:
    """The surface that a user names.

    Args:
        given: a NeuralSurface; the folder of one; a mesh file; a name of the catalogue; an object
            of trimesh; arrays (V, 3), (F, 3); a prepared Surface, which is prepared again for the
            map; or an analytic surface, as ``{"name": ..., parameters}`` or, for a target, by its
            name.
        domain: on which the surface has to lie.
        key: the setting's name, for messages.
        trust: modules whose classes a run folder may name, beside those of nsm and torch.

    Raises:
        NsmError: nothing of these, or a surface that cannot be read or lies on another domain.
    """
    if given is None:
        raise NsmError(
            f"setting {key}: give a mesh file, a catalogue name or a run folder",
            kind="missing_setting",
            key=key,
        )
    if isinstance(given, dict):
        return analytic_surface(given, domain)
    if isinstance(given, Surface):
        if given.raw is None:
            raise NsmError(
                f"{key}={given.name}: no mesh of a file is known to prepare it again; give its "
                "neural surface or the mesh file",
                kind="wrong_type",
                key=key,
            )
        return Mesh(given.name, *given.raw)
    if isinstance(given, NeuralSurface):
        ready = given
    elif not isinstance(given, (str, Path)):
        mesh = given_mesh(given, key)
        return Mesh(mesh.name, mesh.vertices, mesh.faces, mesh.log)
    else:
        name = str(given)
        if is_stored_surface(name):
            ready = load_surface(name, trust=trust)
        elif key == "target" and _is_analytic(name, domain):
            return analytic_surface({"name": name}, domain)
        else:
            mesh = given_mesh(name)
            return Mesh(mesh.name, mesh.vertices, mesh.faces, mesh.log)
    if ready.surface.domain != domain:
        raise NsmError(
            f"{key}={ready.surface.name}: it lies on the {ready.surface.domain}, but domain="
            f"{domain}; all surfaces of a map need the same domain",
            kind="wrong_domain",
            key=key,
        )
    return ready


def _is_analytic(name: str, domain: Domain) -> bool:
    """Whether a target's name means an analytic surface, not the mesh that may share it.

    The closed ones mean the mesh on a domain with boundary, for which it can be cut.
    """
    if name not in ANALYTIC:
        return False
    cut = domain.has_boundary and not lies_over(ANALYTIC[name], domain)
    return not (cut and name in catalogue_names())


def refuse_other_topology(surfaces: Sequence[NeuralSurface]) -> None:
    """Check ready surfaces of a map as :func:`nsm.domains.joint_preparation.prepare_jointly` checks
    meshes; an analytic target is an exception: a closed surface may be torn open for it.

    Raises:
        NsmError: ``wrong_topology``: genus or number of boundary loops differ.
    """
    meshes = [phi.surface for phi in surfaces if not isinstance(phi.map, AnalyticSurface)]
    if len(meshes) > 1:
        check_common_topology([s.name for s in meshes], [s.topology for s in meshes])


def vertex_count(shape: Shape) -> int:
    """How many vertices the mesh file of a shape has."""
    return len(shape.vertices if isinstance(shape, Mesh) else shape.surface.cut_vertex)


def landmark_vertices(
    given: Any, shapes: Sequence[Shape], console: Console | None = None
) -> list[np.ndarray]:
    """Landmarks as vertices (L,) of each shape's mesh file.

    Args:
        given: None; a JSON file; one file or catalogue name, or one list of vertices, points or
            places, per shape; or, for two shapes, a list of pairs. Where all files have names,
            landmarks of one name correspond.
        shapes: two or more.
        console: where to say how far landmarks are moved, and which names are left out.

    Raises:
        NsmError: a file that cannot be read, a landmark that is not on its shape, or given twice,
            or lists of different lengths.
    """
    console = console or Console(quiet=True)
    names = [_name(shape) for shape in shapes]
    lists = [
        listed(item, f"landmarks of {name}")
        for item, name in zip(landmark_lists(given, len(shapes), console), names, strict=True)
    ]
    check_equal_lengths(names, lists)
    result = []
    for list_, shape, name in zip(lists, shapes, names, strict=True):
        found, diagonal = _vertices(list_, shape)
        result.append(found.vertex)
        percent = 100 * found.moved / diagonal
        if percent.max(initial=0.0) > _MOVED:
            largest = f"{percent.max():.3f} % at most"
            console.print(
                f"landmarks of {name}: maps take vertices; moved to the nearest ones by "
                f"{percent.mean():.3f} % of the diagonal in the mean, {largest}",
                highlight=False,
                soft_wrap=True,
            )
    return result


def landmark_lists(given: Any, count: int, console: Console) -> list[Any]:
    """Landmarks as :func:`landmark_vertices` takes them, as a list for each of ``count`` shapes."""
    if given is None:
        return [[] for _ in range(count)]
    lists: list[Any]
    if isinstance(given, (str, Path)):
        lists = list(read_pairs(given)) if count == 2 else read_collection(given)
    elif isinstance(given, dict):
        try:
            lists = [given["source"], given["target"]]
        except KeyError as error:
            raise NsmError(
                f"landmarks: {error} is missing beside the other list",
                kind="missing_setting",
                key="landmarks",
            ) from None
    else:
        lists = as_lists(given)
        if not isinstance(lists, list):
            raise NsmError(
                "landmarks: neither lists of landmarks nor files",
                kind="wrong_type",
                key="landmarks",
            )
        if lists and all(isinstance(item, (str, Path)) for item in lists):
            lists = _corresponding(lists, console)
        elif count == 2 and lists and all(_is_pair(item) for item in lists):
            lists = [[pair[0] for pair in lists], [pair[1] for pair in lists]]
        else:
            lists = [_marks(x).landmarks if isinstance(x, (str, Path)) else x for x in lists]
    if not lists:
        return [[] for _ in range(count)]
    if len(lists) != count:
        raise NsmError(
            f"landmarks: {len(lists)} lists for {count} surfaces; give one for each",
            kind="out_of_range",
            key="landmarks",
        )
    return lists


def _marks(name: str | Path) -> Marks:
    """The landmarks in a file, or those of a mesh of the catalogue."""
    return catalogue_landmarks(str(name)) if has_landmarks(str(name)) else read_marks(name)


def _corresponding(files: Sequence[str | Path], console: Console) -> list[Landmarks]:
    """Landmarks of files in one order: by their names if all files have names, else as they are."""
    marks = [_marks(file) for file in files]
    names = [mark.names for mark in marks if mark.names is not None]
    if len(names) < len(marks):
        return [mark.landmarks for mark in marks]
    common = [name for name in names[0] if all(name in other for other in names)]
    every = list(dict.fromkeys(name for of_one in names for name in of_one))
    missing = [name for name in every if name not in common]
    if not common:
        raise NsmError(
            f"landmarks: {', '.join(map(str, files))} have no name in common; give corresponding "
            "landmarks one name",
            kind="different_names",
            key="landmarks",
        )
    if missing:
        console.print(
            f"landmarks left out, as not all files have them: {', '.join(missing)}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    orders = [[of_one.index(name) for name in common] for of_one in names]
    return [
        as_lists(np.asarray(mark.landmarks)[order])
        for mark, order in zip(marks, orders, strict=True)
    ]


def _is_pair(item: Any) -> bool:
    """Whether an entry is a pair of landmarks, not a whole list of one surface's.

    Two lists of two vertices each look the same; they are read as pairs, which the documentation
    shows.
    """
    return isinstance(item, list) and len(item) == 2


def _name(shape: Shape) -> str:
    return shape.name if isinstance(shape, Mesh) else shape.surface.name


def _vertices(given: Landmarks, shape: Shape) -> tuple[AtVertices, float]:
    """Landmarks at vertices of the shape's file, and the diagonal in the unit of their moves."""
    if isinstance(shape, Mesh):
        diagonal = float(np.linalg.norm(np.ptp(shape.vertices, axis=0)))
        return as_vertices(given, shape.vertices, shape.faces, shape.name), diagonal
    surface = shape.surface
    diagonal = surface.bounding_box_diagonal / surface.scale
    if isinstance(given, list):
        surface.preimages(given)  # raises for one that is not there
        ids = surface.cut_vertex[np.array(given, dtype=np.int64)]
        as_vertices(ids, surface.vertices, None, surface.name)
        return AtVertices(np.asarray(given, dtype=np.int64), np.zeros(len(given))), diagonal
    known = np.flatnonzero(surface.source_vertex >= 0)
    points = shape.in_original_units(surface.vertices[known])
    found = as_vertices(given, points, None, surface.name)
    return found._replace(vertex=surface.source_vertex[known[found.vertex]]), diagonal


def _check_landmarks(surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray]) -> None:
    """NsmError for meshes that the landmarks do not put into correspondence, before the networks
    are trained."""
    try:
        matched_landmarks(surfaces, landmarks)
    except NsmError as error:
        if error.kind != "no_common_seam":
            raise
        names = " and ".join(surface.name for surface in surfaces)
        raise NsmError(
            f"{names}: their boundaries, or the cuts between them, pass the landmarks differently, "
            "so that no map takes one to the other; leave out the landmarks on boundaries and "
            "cuts, or close the holes in a mesh editor",
            kind=error.kind,
            key=error.key,
        ) from error


def neural_surfaces(
    config: DictConfig, shapes: Sequence[Shape], landmarks: Sequence[np.ndarray], console: Console
) -> list[NeuralSurface]:
    """Neural surfaces of the shapes; those that are meshes are prepared jointly, and overfitted.

    Raises:
        NsmError: a mesh that cannot be prepared.
    """
    meshes = {k: shape for k, shape in enumerate(shapes) if isinstance(shape, Mesh)}
    ready = {k: shape for k, shape in enumerate(shapes) if isinstance(shape, NeuralSurface)}
    if meshes:
        alone = len(meshes) == 1
        with stage(console, f"preparing {', '.join(mesh.name for mesh in meshes.values())}"):
            prepared = prepare_jointly(
                list(meshes.values()),
                [np.zeros(0, np.int64) if alone else landmarks[k] for k in meshes],
                domain=domain(config.domain),
                parameterization=config.surface.parameterization,
                seam=config.seam.path,
                seam_landmarks=config.seam.landmarks,
                cache=config.surface.cache,
                repairs=configured_repairs(config),
                processes=config.phi.get("processes"),
            )
        if not ready:
            _check_landmarks(prepared, landmarks)
        for surface in prepared:
            report_surface(console, surface)
        ready.update(zip(meshes, cached_surfaces(prepared, config, console), strict=True))
    return [ready[k] for k in range(len(shapes))]
