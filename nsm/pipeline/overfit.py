"""task=overfit: one surface becomes a network."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
from omegaconf import DictConfig
from rich.console import Console

from nsm.data import EnsembleData
from nsm.domains import Surface
from nsm.maps.networks import SKIPS
from nsm.pipeline.common import (
    Run,
    built,
    configured_surface,
    frozen,
    plain,
    report_surface,
    say_where,
    train,
    trained,
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
from nsm.tasks import Overfit, OverfitEnsemble
from nsm.tasks.ensemble import Ensemble
from nsm.tasks.least_squares import fit_linear_skip
from nsm.tasks.optimizers import shared_options


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
    return overfitted(config, folder, surface, console, started, resuming=resuming)


def overfitted(
    config: DictConfig,
    folder: Path,
    surface: Surface,
    console: Console,
    started: float,
    *,
    resuming: bool,
) -> NeuralSurface:
    """:func:`run_overfit` of a surface that has been reported.

    Args:
        config, folder, surface, resuming: as for :func:`run_overfit`.
        console: where to print.
        started: when the run began, by ``time.monotonic``.

    Raises:
        NsmError: as :func:`run_overfit`.
    """
    module = build_overfit(config, surface)
    shown = surface
    pictures = _pictures(config, lambda module: shown)
    trainer = train(config, folder, surface, module, console, pictures, resuming=resuming)
    return leave_results(config, folder, surface, module, trainer, console, started)


def leave_results(
    config: DictConfig,
    folder: Path,
    surface: Surface,
    module: Overfit,
    trainer: pl.Trainer,
    console: Console,
    started: float,
    *,
    index: int = 0,
) -> NeuralSurface:
    """Measure a trained network, and leave its results in the run folder.

    Args:
        config, folder, surface, module: of the run.
        trainer: that has trained it, or several in one batch, of which it is number ``index``.
        console: where to print.
        started: when the run began, by ``time.monotonic``.
        index: see ``trainer``.
    """
    phi = frozen(module.map)
    neural = NeuralSurface(surface, phi, overfit_metrics(surface, phi), plain(config))
    save_surface(folder, neural)
    if config.artefacts:
        _write_artefacts(folder, neural)
    figures: dict[str, Any] = {"metrics": neural.metrics}
    if isinstance(trainer.lightning_module, Ensemble):
        figures["batched"] = len(trainer.lightning_module.each)
    write_figures(config, folder, surface, trainer, started, figures, index)
    console.print(metrics_table(neural.metrics))
    say_where(console, folder)
    return neural


def common_settings(settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """What the settings of trainings must have in common to be made in one batch.

    Surface, seed, λ_n and the optimiser's rates may differ.

    Args:
        settings: the whole configuration, as plain dictionaries and lists.

    Returns:
        None if the training has to be made alone.
    """
    trainer, optimizer = settings["trainer"], shared_options(settings["optimizer"])
    whole = (trainer["stop_gradient_norm"], trainer["gradient_clip"])  # look at all gradients
    if (
        settings["task"]["name"] != "overfit"
        or settings["map"]["block"] not in SKIPS
        or optimizer is None
        or trainer["devices"] > 1
        or whole != (None, None)
        or "wandb" in settings["logger"]["kinds"]  # one run at a time
    ):
        return None
    own = ("surface", "domain", "seed", "artefacts", "resume")
    energy = {key: v for key, v in settings["energy"].items() if key != "lambda_normal"}
    rest = {key: value for key, value in settings.items() if key not in own}
    return {**rest, "energy": energy, "optimizer": optimizer}


def overfit_ensemble(
    runs: Sequence[Run], surfaces: Sequence[Surface], console: Console
) -> tuple[list[Overfit], pl.Trainer]:
    """Train several networks in one batch, each in its run folder, as each would be alone.

    Args:
        runs: with :func:`common_settings`, and checkpoints of one step if they go on.
        surfaces: of each.
        console: where to print.

    Returns:
        The trained modules, and the trainer, for :func:`leave_results`.

    Raises:
        NsmError: settings that do not fit together.
        EnsembleSplit: some have to be trained alone; all have whole checkpoints, if any.
    """
    config = runs[0].config
    modules: list[Overfit] = []
    starts: dict[tuple[int, int], Overfit] = {}
    for run, surface in zip(runs, surfaces, strict=True):
        place = id(surface), run.config.seed
        modules.append(build_overfit(run.config, surface, start=starts.get(place)))
        starts.setdefault(place, modules[-1])
    surface_of = dict(zip(modules, surfaces, strict=True))
    seeds = [run.config.seed for run in runs]
    trainer = trained(
        runs,
        EnsembleData(surfaces, seeds, **plain(config)["data"]),
        OverfitEnsemble(modules),
        console,
        _pictures(config, lambda module: surface_of[module]),
        f"overfit {len(runs)} networks",
    )
    return modules, trainer


def _pictures(config: DictConfig, surface_of: Callable[[Any], Surface]) -> Pictures:
    def draw(module: Any) -> np.ndarray:
        return reconstruction_image(surface_of(module), module, size=384)

    return Pictures("surface", draw, config.logger.pictures)


def build_overfit(config: DictConfig, surface: Surface, start: Overfit | None = None) -> Overfit:
    """The overfit task's module, seeded, and fitted where ``map.linear_skip`` says so.

    Args:
        config, surface: of the run.
        start: a module of the same surface, seed and network that is not trained yet, whose fit is
            taken.

    Raises:
        NsmError: settings of the network, optimiser or schedule that do not fit together.
    """

    def make(common: dict[str, Any]) -> Overfit:
        module = Overfit(
            **with_map(common, out_dim=3),
            lambda_normal=float(config.energy.lambda_normal),
            diagonal=surface.bounding_box_diagonal,
        )
        if start is not None:
            module.load_state_dict(start.state_dict())
        elif config.map.linear_skip == "fitted":
            fit_linear_skip(module.map, surface, seed=config.seed)
        return module

    return built(config, make)


def _write_artefacts(folder: Path, neural: NeuralSurface) -> None:
    vertices, faces, uv = neural.to_mesh()
    export_mesh(folder / "reconstruction.obj", vertices, faces, uv)
    export_mesh(folder / "reconstruction.glb", vertices, faces, uv, texture=checkerboard())
    error_picture(folder / "error.png", neural.surface, neural)
    checkerboard_picture(folder / "checkerboard.png", neural.surface, neural)
