"""The surface that the group ``surface`` names."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Surface, domain
from nsm.stages import stage
from nsm.surfaces.validation import Repairs
from nsm.wording import number_of


def keep_absolute(config: DictConfig) -> None:
    """Make the path of the group ``surface`` absolute, to resume the run from any folder."""
    if config.surface.path is not None:
        config.surface.path = os.path.abspath(config.surface.path)


def named_mesh(config: DictConfig) -> str:
    """The mesh file, or the name of the catalogue, of the group ``surface``."""
    settings = config.surface
    return str(settings.name if settings.path is None else settings.path)


def configured_repairs(config: DictConfig) -> Repairs:
    """The decisions of the group ``surface`` on meshes; older run folders have none."""
    chosen = config.surface
    return Repairs(chosen.get("parts"), chosen.get("repair"), chosen.get("fill_holes", False))


def configured_surface(config: DictConfig, console: Console, given: Any = None) -> Surface:
    """The surface of the group ``surface``, prepared; the console shows that it goes on.

    Args:
        given: a mesh in its place, as :meth:`Surface.load` takes it, or a prepared surface.

    Raises:
        NsmError: a mesh that cannot be used.
    """
    if isinstance(given, Surface):
        return given
    keep_absolute(config)
    settings = config.surface
    if given is None:
        given = named_mesh(config)
    name = Path(given).stem if isinstance(given, (str, Path)) else "mesh"
    with stage(console, f"preparing {name}"):
        return Surface.load(
            given,
            domain=domain(config.domain),
            seam_vertices=settings.seam_vertices,
            cones=settings.get("cones"),  # absent in older run folders
            parameterization=settings.parameterization,
            cache=settings.cache,
            repairs=configured_repairs(config),
        )


def report_surface(console: Console, surface: Surface) -> None:
    """Print what a prepared surface is, and how its mesh was changed."""
    console.print(
        f"{surface.name}: {len(surface.vertices)} vertices, "
        f"{number_of(len(surface.faces), 'face')} on the "
        f"{surface.domain}, median symmetric Dirichlet "
        f"{surface.quality['median_symmetric_dirichlet']:.2f}",
        soft_wrap=True,
    )
    for line in surface.log:
        console.print(f"  {line}", soft_wrap=True)
