"""The charts into which seams that a user gives cut a mesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Surface, domain
from nsm.domains.embedding import GIVEN
from nsm.errors import NsmError
from nsm.pipeline.configured_surface import configured_repairs, named_mesh, report_surface
from nsm.pipeline.surface_cache import cached_surfaces
from nsm.results import NeuralSurface
from nsm.stages import stage
from nsm.surfaces.given import GivenMesh, given_mesh
from nsm.surfaces.seams import charts, count_of, kept_edges, read_seams
from nsm.surfaces.validation import clean


def neural_charts(
    config: DictConfig, console: Console, given: Any, seams: Any
) -> list[NeuralSurface]:
    """Neural surfaces of the charts of a mesh, those with most faces first.

    Args:
        config: of task=param.
        console: where to print.
        given: in place of the mesh of the group ``surface``, one as :meth:`Surface.load` takes it,
            or a prepared surface, whose mesh is cut again.
        seams: as :func:`nsm.surfaces.seams.read_seams` takes them.

    Raises:
        NsmError: ``conflicting_settings``: a neural surface, which is cut already; or a mesh or
            seams that cannot be used.
    """
    if isinstance(given, NeuralSurface) or config.phi.path is not None and given is None:
        raise NsmError(
            "seams: a neural surface is cut already; give its mesh, or leave the seams out",
            kind="conflicting_settings",
            key="seams",
        )
    if config.surface.parameterization == GIVEN:
        raise NsmError(
            "surface.parameterization=given: it cuts the mesh along its texture coordinates; leave "
            "the seams out",
            kind="conflicting_settings",
            key="seams",
        )
    given = named_mesh(config) if given is None else given
    mesh = _raw(given)
    file = given if isinstance(given, (str, Path)) else None
    edges = read_seams(seams, file, mesh.faces, mesh.name)
    cleaned = clean(mesh.vertices, mesh.faces, mesh.name, configured_repairs(config))
    parts = charts(cleaned, kept_edges(edges, cleaned), mesh.name)
    several = len(parts) > 1
    console.print(f"{mesh.name}: {count_of(parts)}" if several else f"{mesh.name}: one chart")
    surfaces = []
    with stage(console, f"preparing {mesh.name}"):
        for k, cut in enumerate(parts):
            surface = Surface.from_cut(
                cut,
                cleaned,
                name=f"{mesh.name}-{k}" if several else mesh.name,
                domain=domain(config.domain),
                parameterization=config.surface.parameterization,
                log=() if k else (*mesh.log, *cleaned.log),
            )
            surfaces.append(replace(surface, raw=(mesh.vertices, mesh.faces)))
    for surface in surfaces:
        report_surface(console, surface)
    return cached_surfaces(surfaces, config, console)


def _raw(given: Any) -> GivenMesh:
    if not isinstance(given, Surface):
        return given_mesh(given)
    if given.raw is None:
        raise NsmError(
            f"{given.name}: a surface of a run folder has no mesh to cut again; give the mesh",
            kind="wrong_type",
            key="seams",
        )
    return GivenMesh(given.name, *given.raw)
