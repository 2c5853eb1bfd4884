"""task=overfit: one surface becomes a network."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path

from filelock import FileLock
from omegaconf import DictConfig
from rich.console import Console

from nsm.config import compose_config
from nsm.errors import NsmError
from nsm.pipeline.common import (
    CHECKPOINT_FILE,
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
    load_surface,
    metrics_table,
    overfit_metrics,
    reconstruction_image,
    save_surface,
)
from nsm.results.callbacks import Pictures
from nsm.surfaces import Surface
from nsm.surfaces.cache import cache_folder
from nsm.tasks import Overfit

# settings that do not change what a neural surface becomes
_INCIDENTAL = (
    "surface",
    "phi",
    "logger",
    "resume",
    "source",
    "target",
    "surfaces",
    "landmarks",
    "attributes",
    "artefacts",
    "seam",
    "constraints",
    "guarantee",
)


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


def neural_surface(config: DictConfig, console: Console) -> NeuralSurface:
    """The neural surface that a map's configuration names, made if it is not there yet.

    Raises:
        NsmError: a mesh, neural surface or setting that cannot be used.
    """
    if config.phi.path is not None:
        phi = load_surface(config.phi.path)
        if phi.surface.domain != config.domain:
            raise NsmError(
                f"{config.phi.path}: its domain is the {phi.surface.domain}, but domain="
                f"{config.domain}; give domain={phi.surface.domain}"
            )
        return phi
    return made_once(configured_surface(config), config, console)


def made_once(surface: Surface, config: DictConfig, console: Console) -> NeuralSurface:
    """The neural surface of a prepared one, from the cache if it was made before.

    Raises:
        NsmError: settings in ``phi.overrides`` that cannot be used.
    """
    words = [
        "task=overfit",
        "logger=none",
        "artefacts=false",
        f"domain={config.domain}",
        f"seed={config.seed}",
    ]
    progress = f"trainer.progress={str(config.trainer.progress).lower()}"
    overfit = compose_config([*words, progress, *config.phi.overrides])
    settings = {k: v for k, v in plain(overfit).items() if k not in _INCIDENTAL}
    settings["trainer"].pop("progress")
    text = surface.content_key() + json.dumps(settings, sort_keys=True)
    folder = cache_folder() / "neural" / hashlib.sha256(text.encode()).hexdigest()[:32]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_suffix(".lock")):  # jobs of a sweep may want the same one
        if (folder / "metrics.json").exists():
            console.print(f"{surface.name}: neural surface taken from the cache")
            return load_surface(folder)
        return run_overfit(overfit, folder, surface, resuming=(folder / CHECKPOINT_FILE).exists())


def build_overfit(config: DictConfig, surface: Surface) -> Overfit:
    """The overfit task's module, seeded.

    Raises:
        NsmError: settings of the network, optimiser or schedule that do not fit together.
    """
    return built(
        config,
        lambda common: Overfit(
            **with_map(common, out_dim=3),
            lambda_normal=float(config.energy.lambda_normal),
            diagonal=surface.bounding_box_diagonal,
        ),
    )


def _write_artefacts(folder: Path, neural: NeuralSurface) -> None:
    vertices, faces, uv = neural.to_mesh()
    export_mesh(folder / "reconstruction.obj", vertices, faces, uv)
    export_mesh(folder / "reconstruction.glb", vertices, faces, uv, texture=checkerboard())
    error_picture(folder / "error.png", neural.surface, neural)
    checkerboard_picture(folder / "checkerboard.png", neural.surface, neural)
