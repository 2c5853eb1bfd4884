"""task=overfit: one surface becomes a network."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console

from nsm.pipeline.common import (
    built,
    configured_surface,
    plain,
    report_surface,
    train,
    with_map,
    write_figures,
)
from nsm.results import (
    NeuralSurface,
    checkerboard,
    checkerboard_picture,
    error_picture,
    export_mesh,
    metrics_table,
    overfit_metrics,
    reconstruction_image,
    save_surface,
)
from nsm.results.callbacks import Pictures
from nsm.surfaces import Surface
from nsm.tasks import Overfit
from nsm.tasks.least_squares import fit_readout


def run_overfit(
    config: DictConfig,
    folder: Path,
    surface: Surface | None = None,
    *,
    resuming: bool = False,
) -> NeuralSurface:
    """Overfit one surface, and leave all of its results in the folder.

    Args:
        config: as :func:`nsm.config.compose_config` gives it.
        folder: the run folder.
        surface: the surface, where it is at hand; else it is loaded as configured.
        resuming: go on from the folder's checkpoint.

    Raises:
        NsmError: a mesh, setting or run folder that cannot be used.
    """
    console = Console(highlight=False, markup=False)
    started = time.monotonic()
    if surface is None:
        surface = configured_surface(config)
    report_surface(console, surface)
    module = build_overfit(config, surface)
    shown = surface
    trainer = train(
        config,
        folder,
        surface,
        module,
        console,
        Pictures(
            "surface",
            lambda m: reconstruction_image(shown, m, size=384),  # type: ignore[arg-type]
            config.logger.pictures,
        ),
        resuming=resuming,
    )
    phi = module.map.cpu().eval().requires_grad_(False)
    neural = NeuralSurface(surface, phi, overfit_metrics(surface, phi), plain(config))
    save_surface(folder, neural)
    if config.artefacts:
        _write_artefacts(folder, neural)
    write_figures(config, folder, surface, trainer, started, {"metrics": neural.metrics})
    console.print(metrics_table(neural.metrics))
    console.print(f"results in {folder}", soft_wrap=True)
    return neural


def build_overfit(config: DictConfig, surface: Surface) -> Overfit:
    """The overfit task's module, seeded, and fitted where ``map.readout`` says so.

    Raises:
        NsmError: settings of the network, optimiser or schedule that do not fit together.
    """

    def make(common: dict[str, Any]) -> Overfit:
        module = Overfit(
            **with_map(common, out_dim=3),
            lambda_normal=float(config.energy.lambda_normal),
            diagonal=surface.bounding_box_diagonal,
        )
        if config.map.readout == "fitted":
            fit_readout(module.map, surface, seed=config.seed)
        return module

    return built(config, make)


def _write_artefacts(folder: Path, neural: NeuralSurface) -> None:
    vertices, faces, uv = neural.to_mesh()
    export_mesh(folder / "reconstruction.obj", vertices, faces, uv)
    export_mesh(folder / "reconstruction.glb", vertices, faces, uv, texture=checkerboard())
    error_picture(folder / "error.png", neural.surface, neural)
    checkerboard_picture(folder / "checkerboard.png", neural.surface, neural)
