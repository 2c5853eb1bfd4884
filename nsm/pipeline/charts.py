"""The charts into which seams, or texture coordinates, that a user gives cut a mesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Surface, domain
from nsm.domains.embedding import GIVEN
from nsm.domains.given_layout import check_given, islands_as_given
from nsm.errors import NsmError
from nsm.pipeline.configured_surface import (
    configured_repairs,
    keep_absolute,
    named_mesh,
    report_surface,
)
from nsm.pipeline.surface_cache import cached_surfaces
from nsm.results import NeuralSurface
from nsm.stages import stage
from nsm.surfaces.cutting import Cut
from nsm.surfaces.given import GivenMesh, given_mesh
from nsm.surfaces.seams import UV, charts, count_of, kept_edges, read_seams
from nsm.surfaces.textures import read_uv
from nsm.surfaces.validation import CleanMesh, clean


def neural_charts(
    config: DictConfig, console: Console, given: Any, seams: Any
) -> list[NeuralSurface]:
    """Neural surfaces of the charts of a mesh, those with most faces first.

    Args:
        config: of task=param.
        console: where to print.
        given: in place of the mesh of the group ``surface``, one as :meth:`Surface.load` takes it,
            or a prepared surface, whose mesh is cut again.
        seams: as :func:`nsm.surfaces.seams.read_seams` takes them; None or ``uv`` where the layout
            starts from texture coordinates.

    Raises:
        NsmError: ``conflicting_settings``: a neural surface, which is cut already, or other seams
            than those of the texture coordinates; or a mesh or seams that cannot be used.
    """
    if isinstance(given, NeuralSurface) or config.phi.path is not None and given is None:
        raise NsmError(
            "seams: a neural surface is cut already; give its mesh, or leave the seams out",
            kind="conflicting_settings",
            key="seams",
        )
    keep_absolute(config)
    given = named_mesh(config) if given is None else given
    mesh = _raw(given)
    file = given if isinstance(given, (str, Path)) else None
    cleaned = clean(mesh.vertices, mesh.faces, mesh.name, configured_repairs(config))
    parts: Sequence[tuple[Cut, np.ndarray | None]]
    if config.surface.parameterization == GIVEN:
        parts = _islands(config, mesh, cleaned, file, seams)
    else:
        edges = read_seams(seams, file, mesh.faces, mesh.name)
        parts = [(cut, None) for cut in charts(cleaned, kept_edges(edges, cleaned), mesh.name)]
    several = len(parts) > 1
    found = count_of([cut for cut, _ in parts]) if several else "one chart"
    console.print(f"{mesh.name}: {found}", soft_wrap=True)
    surfaces = []
    with stage(console, f"preparing {mesh.name}"):
        for k, (cut, layout) in enumerate(parts):
            surface = Surface.from_cut(
                cut,
                cleaned,
                name=f"{mesh.name}-{k}" if several else mesh.name,
                domain=domain(config.domain),
                parameterization=config.surface.parameterization,
                log=() if k else (*mesh.log, *cleaned.log),
                given=layout,
            )
            surfaces.append(replace(surface, raw=(mesh.vertices, mesh.faces)))
    for surface in surfaces:
        report_surface(console, surface)
    return cached_surfaces(surfaces, config, console)


def _islands(
    config: DictConfig, mesh: GivenMesh, cleaned: CleanMesh, file: str | Path | None, seams: Any
) -> list[tuple[Cut, np.ndarray]]:
    """The islands of a mesh file's texture coordinates, and where these lay their vertices."""
    if seams not in (None, UV):
        raise NsmError(
            "surface.parameterization=given: it cuts the mesh along its texture coordinates; leave "
            "the seams out",
            kind="conflicting_settings",
            key="seams",
        )
    uv = read_uv(file) if file is not None and Path(file).is_file() else None
    seam = config.surface.seam_vertices
    uv = check_given(uv, mesh.faces, domain(config.domain), seam, mesh.name)
    return islands_as_given(cleaned, mesh.faces, uv, mesh.name)


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
