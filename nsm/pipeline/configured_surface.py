"""The surface that the group ``surface`` names."""

from __future__ import annotations

import os

from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Surface, domain


def configured_surface(config: DictConfig) -> Surface:
    """The surface of the group ``surface``, prepared; its path becomes absolute, so that a run can
    be resumed from any folder.

    Raises:
        NsmError: a mesh that cannot be used.
    """
    settings = config.surface
    if settings.path is not None:
        settings.path = os.path.abspath(settings.path)
    return Surface.load(
        settings.path if settings.path is not None else settings.name,
        domain=domain(config.domain),
        seam_vertices=settings.seam_vertices,
        parameterization=settings.parameterization,
        cache=settings.cache,
    )


def report_surface(console: Console, surface: Surface) -> None:
    """Print what a prepared surface is, and how its mesh was changed."""
    console.print(
        f"{surface.name}: {len(surface.vertices)} vertices, {len(surface.faces)} faces on the "
        f"{surface.domain}, median symmetric Dirichlet "
        f"{surface.quality['median_symmetric_dirichlet']:.2f}",
        soft_wrap=True,
    )
    for line in surface.log:
        console.print(f"  {line}", soft_wrap=True)
