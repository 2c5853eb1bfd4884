"""From settings that name surfaces and landmarks to neural surfaces and vertices."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Domain, Surface, domain
from nsm.domains.joint_preparation import Mesh, check_common_topology, prepare_jointly
from nsm.domains.matched_landmarks import cut_together, matched_landmarks, with_ends
from nsm.errors import NsmError
from nsm.maps import ANALYTIC, AnalyticSurface
from nsm.pipeline.configured_surface import configured_repairs, report_surface
from nsm.pipeline.surface_cache import cached_surfaces
from nsm.results import NeuralSurface, analytic_surface, load_surface
from nsm.results.analytic import lies_over
from nsm.results.artifact import is_stored_surface
from nsm.stages import stage
from nsm.surfaces.catalogue import (
    catalogue_names,
)
from nsm.surfaces.given import given_mesh

Shape = NeuralSurface | Mesh


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
        NsmError: ``wrong_topology``: genus or number of boundary loops differ; ``no_common_seam``:
            surfaces with several boundaries that were cut apart from each other.
    """
    _refuse([phi.surface for phi in surfaces if not isinstance(phi.map, AnalyticSurface)])


def _refuse(meshes: Sequence[Surface]) -> None:
    if len(meshes) < 2:
        return
    names = [s.name for s in meshes]
    genus, loops = check_common_topology(names, [s.topology for s in meshes])
    if genus == 0 and loops > 1 and not cut_together(meshes):
        raise NsmError(
            f"{' and '.join(names)} have {loops} boundaries each and were not cut together, so "
            "that no map takes boundaries to boundaries: give the mesh files of all, without "
            "seam.path=own; or fill small holes with surface.fill_holes=true",
            kind="no_common_seam",
            key=names[0],
        )


def vertex_count(shape: Shape) -> int:
    """How many vertices the mesh file of a shape has."""
    return len(shape.vertices if isinstance(shape, Mesh) else shape.surface.cut_vertex)


def _check_landmarks(surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray]) -> None:
    """NsmError for meshes that the landmarks do not put into correspondence, before the networks
    are trained."""
    try:
        matched_landmarks(surfaces, with_ends(surfaces, landmarks))
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
    config: DictConfig,
    shapes: Sequence[Shape],
    landmarks: Sequence[np.ndarray],
    console: Console,
    shown: Callable[[list[Surface]], None] = lambda _: None,
    cones: Sequence[int] | None = None,
) -> list[NeuralSurface]:
    """Neural surfaces of the shapes; those that are meshes are prepared jointly, and overfitted.

    Args:
        config: of the map.
        shapes: two or more.
        landmarks: vertices (L,) of each.
        console: where to print.
        shown: is given all surfaces, checked and laid out, before any network is trained.
        cones: as for :func:`nsm.domains.joint_preparation.prepare_jointly`.

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
                cones=None if alone else cones,
                repairs=configured_repairs(config),
                processes=config.phi.get("processes"),
            )
        known = [phi.surface for phi in ready.values() if not isinstance(phi.map, AnalyticSurface)]
        _refuse([*prepared, *known])
        if not ready:
            _check_landmarks(prepared, landmarks)
        for surface in prepared:
            report_surface(console, surface)
        laid_out = dict(zip(meshes, prepared, strict=True))
        with stage(console, f"picture of {', '.join(surface.name for surface in prepared)}"):
            shown([laid_out.get(k) or ready[k].surface for k in range(len(shapes))])
        ready.update(zip(meshes, cached_surfaces(prepared, config, console), strict=True))
    else:
        shown([ready[k].surface for k in range(len(shapes))])
    return [ready[k] for k in range(len(shapes))]
