"""From a checked configuration to a run folder with results."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.callbacks import Callback, LearningRateMonitor
from pytorch_lightning.loggers import TensorBoardLogger
from rich.console import Console

from nsm.config import checked, compose_config
from nsm.data import OverfitData
from nsm.errors import NsmError
from nsm.results import (
    NeuralSurface,
    Parameterization,
    atomic_write,
    checkerboard,
    checkerboard_picture,
    comparison_table,
    error_picture,
    export_mesh,
    layout_image,
    load_surface,
    metrics_table,
    overfit_metrics,
    parameterization_picture,
    planar_metrics,
    reconstruction_image,
    save_surface,
)
from nsm.results.callbacks import AtomicCheckpoint, GradientWatch, Pictures
from nsm.results.progress import TrainingProgress
from nsm.surfaces import Surface
from nsm.surfaces.baselines import BASELINES
from nsm.surfaces.cache import cache_folder
from nsm.tasks import Overfit, Param

CONFIG_FILE = "config.yaml"
CHECKPOINT_FILE = "last.ckpt"
# settings that do not change what a neural surface becomes
_INCIDENTAL = ("surface", "phi", "logger", "resume")


def run(config: DictConfig, folder: Path) -> None:
    """Run the task of a configuration in a folder.

    With ``resume`` set, the folder's own configuration takes its place, and the training goes on
    from its checkpoint.

    Raises:
        NsmError: bad input of any kind.
    """
    resuming = config.resume is not None
    if resuming:
        config = _stored_config(folder)
    tasks: dict[str, Callable[..., Any]] = {"overfit": run_overfit, "param": run_param}
    if config.task.name not in tasks:
        raise NsmError(f"task.name={config.task.name} is not one of {', '.join(tasks)}")
    tasks[config.task.name](config, folder, resuming=resuming)


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
    console = Console(highlight=False)
    started = time.monotonic()
    if surface is None:
        surface = _load_surface(config)
    _report_surface(console, surface)
    module = build_overfit(config, surface)
    shown = surface
    trainer = _train(
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
    neural = NeuralSurface(surface, phi, overfit_metrics(surface, phi), _plain(config))
    _write_surface(folder, neural)
    _write_figures(folder, surface, trainer, started, {"metrics": neural.metrics})
    console.print(metrics_table(neural.metrics))
    console.print(f"results in {folder}", soft_wrap=True)
    return neural


def run_param(
    config: DictConfig,
    folder: Path,
    phi: NeuralSurface | None = None,
    *,
    resuming: bool = False,
) -> Parameterization:
    """Flatten a neural surface with least distortion, and compare with libigl's methods.

    Args:
        config: as :func:`nsm.config.compose_config` gives it, with ``task=param``.
        folder: the run folder.
        phi: the neural surface, where it is at hand; else that of ``phi.path``, else one that is
            made of the configured mesh, or taken from the cache if it was made before.
        resuming: go on from the folder's checkpoint.

    Raises:
        NsmError: a mesh, neural surface, setting or run folder that cannot be used.
    """
    console = Console(highlight=False)
    started = time.monotonic()
    if phi is None:
        phi = neural_surface(config, console)
    surface = phi.surface
    module = build_param(config, phi)

    def picture(m: pl.LightningModule) -> np.ndarray:
        uv = m(torch.as_tensor(surface.uv, dtype=torch.float32, device=m.device))
        image = layout_image(surface, uv.detach().cpu().double().numpy())
        return np.round(255 * image).astype(np.uint8)

    pictures = Pictures("layout", picture, config.logger.pictures)
    trainer = _train(config, folder, surface, module, console, pictures, resuming=resuming)
    planar = module.map.cpu().eval().requires_grad_(False)
    result = Parameterization(phi, planar, {}, _plain(config))
    maps = {"domain": surface.uv, "nsm": result.uv}
    for name, method in BASELINES.items():
        try:
            maps[f"{name} (libigl)"] = method(surface.vertices, surface.faces, surface.uv)
        except RuntimeError as error:
            console.print(f"  {name} of libigl failed: {error}")
    for name, uv in maps.items():
        result.metrics[name] = planar_metrics(surface.vertices, surface.faces, uv)

    result.save(folder)
    inside = _into_square(result.uv)
    for ending, texture in (("obj", None), ("glb", checkerboard())):
        file = folder / f"parameterized.{ending}"
        export_mesh(file, surface.vertices, surface.faces, inside, texture=texture)
    picture_file = folder / "checkerboard.png"
    before_after = {"before: domain Ω": maps["domain"], "after": maps["nsm"]}
    parameterization_picture(picture_file, surface, before_after)
    _write_figures(folder, surface, trainer, started, {"metrics": result.metrics})
    console.print(comparison_table(result.metrics))
    ours = result.metrics["nsm"]
    if ours["flipped_percent"] == 0 and ours["boundary_self_intersections"]:
        console.print(
            "nothing is flipped, but the image overlaps itself; energy.boundary=fixed keeps it in Ω"
        )
    console.print(f"results in {folder}", soft_wrap=True)
    return result


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
    surface = _load_surface(config)
    words = ["task=overfit", "logger=none", f"domain={config.domain}", f"seed={config.seed}"]
    overfit = compose_config([*words, *config.phi.overrides])
    settings = {k: v for k, v in _plain(overfit).items() if k not in _INCIDENTAL}
    text = surface.content_key() + json.dumps(settings, sort_keys=True)
    folder = cache_folder() / "neural" / hashlib.sha256(text.encode()).hexdigest()[:32]
    if (folder / "metrics.json").exists():
        console.print(f"{surface.name}: neural surface taken from the cache")
        return load_surface(folder)
    return run_overfit(overfit, folder, surface, resuming=(folder / CHECKPOINT_FILE).exists())


def build_overfit(config: DictConfig, surface: Surface) -> Overfit:
    """The overfit task's module, seeded.

    Raises:
        NsmError: settings of the network, optimiser or schedule that do not fit together.
    """
    return _built(
        config,
        lambda common: Overfit(
            **_with_map(common, out_dim=3),
            lambda_normal=float(config.energy.lambda_normal),
            diagonal=surface.bounding_box_diagonal,
        ),
    )


def build_param(config: DictConfig, phi: NeuralSurface) -> Param:
    """The param task's module, seeded.

    Raises:
        NsmError: settings of the network, energy, optimiser or schedule that do not fit together.
    """
    energy = config.energy
    return _built(
        config,
        lambda common: Param(
            **_with_map(common),
            domain=config.domain,
            weights={name: float(w) for name, w in energy.weights.items()},
            lambda_injectivity=float(energy.lambda_injectivity),
            lambda_boundary=float(energy.lambda_boundary),
            boundary=energy.boundary,
            phi=phi.map,
        ),
    )


def _built(config: DictConfig, make: Callable[[dict[str, Any]], Any]) -> Any:
    pl.seed_everything(config.seed, verbose=False)
    try:
        module = make(_plain(config))
        module.configure_optimizers()  # settings that do not fit are told before any work
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise NsmError(f"setting: {' '.join(str(error).split())}") from error
    return module


def _with_map(settings: dict[str, Any], **network: Any) -> dict[str, Any]:
    groups = {"activation": settings["activation"], "encoding": settings["encoding"]}
    return {
        "map": {**network, **settings["map"], **groups},
        "optimizer": settings["optimizer"],
        "scheduler": settings["scheduler"],
        "max_steps": settings["trainer"]["max_steps"],
    }


def _plain(config: DictConfig) -> dict[str, Any]:
    container = OmegaConf.to_container(config)
    assert isinstance(container, dict)
    return container  # type: ignore[return-value]


def _stored_config(folder: Path) -> DictConfig:
    file = folder / CONFIG_FILE
    if not file.is_file():
        raise NsmError(f"resume={folder}: no {CONFIG_FILE} there; give the folder of a run")
    stored = OmegaConf.load(file)
    if not isinstance(stored, DictConfig):
        raise NsmError(f"{file}: not a configuration; start the run again")
    return checked(stored)


def _load_surface(config: DictConfig) -> Surface:
    settings = config.surface
    if settings.path is not None:
        settings.path = os.path.abspath(settings.path)  # resuming works from any folder
    return Surface.load(
        settings.path if settings.path is not None else settings.name,
        domain=config.domain,
        seam_vertices=settings.seam_vertices,
        parameterization=settings.parameterization,
        cache=settings.cache,
    )


def _report_surface(console: Console, surface: Surface) -> None:
    console.print(
        f"{surface.name}: {len(surface.vertices)} vertices, {len(surface.faces)} faces on the "
        f"{surface.domain}, median symmetric Dirichlet "
        f"{surface.quality['median_symmetric_dirichlet']:.2f}",
        soft_wrap=True,
    )
    for line in surface.log:
        console.print(f"  {line}", soft_wrap=True)


def _train(
    config: DictConfig,
    folder: Path,
    surface: Surface,
    module: Overfit | Param,
    console: Console,
    pictures: Pictures,
    *,
    resuming: bool,
) -> pl.Trainer:
    """Train a module in its run folder; KeyboardInterrupt if the user stops it."""
    data = OverfitData(surface, **_plain(config)["data"], seed=config.seed)
    settings = config.trainer
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    callbacks: list[Callback] = [
        GradientWatch(config.logger.every, settings.stop_gradient_norm, settings.stop_window),
        AtomicCheckpoint(folder / CHECKPOINT_FILE),
    ]
    if settings.progress:
        title = f"{config.task.name} {surface.name}"
        shown = (module.progress_figure, module.progress_form)
        callbacks.append(TrainingProgress(console, title, *shown))
    logger: TensorBoardLogger | bool = False
    if config.logger.tensorboard:
        logger = TensorBoardLogger(save_dir=folder, name="", version="tensorboard")
        callbacks += [LearningRateMonitor(), pictures]
    quiet_lightning()
    accelerator = settings.accelerator
    if accelerator == "auto":  # Lightning would choose Apple's GPU, which has no float64
        accelerator = "gpu" if torch.cuda.is_available() else "cpu"
    try:
        trainer = pl.Trainer(
            accelerator=accelerator,
            devices=1,
            max_steps=settings.max_steps,
            max_epochs=-1,
            gradient_clip_val=settings.gradient_clip,
            logger=logger,
            callbacks=callbacks,
            log_every_n_steps=config.logger.every,
            num_sanity_val_steps=0,
            enable_progress_bar=False,
            enable_model_summary=False,
            enable_checkpointing=False,
        )
    except Exception as error:  # Lightning's own exceptions for hardware that is not there
        reason = " ".join(str(error).split())
        raise NsmError(f"setting trainer.accelerator={accelerator}: {reason}") from error
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write(folder / CONFIG_FILE, OmegaConf.to_yaml(config).encode())
    # killed before the first checkpoint, a run starts again from its beginning
    checkpoint = folder / CHECKPOINT_FILE
    _fit(trainer, module, data, checkpoint if resuming and checkpoint.is_file() else None)
    if trainer.interrupted:
        console.print(f"interrupted; go on with: nsm resume={folder}", soft_wrap=True)
        raise KeyboardInterrupt
    return trainer


def quiet_lightning() -> None:
    """Leave out Lightning's remarks on data loaders and hardware: they do not concern samples that
    are made on the device."""
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="pytorch_lightning")
    warnings.filterwarnings("ignore", module="lightning_fabric")


def _fit(
    trainer: pl.Trainer, module: pl.LightningModule, data: OverfitData, checkpoint: Path | None
) -> None:
    if checkpoint is None:
        trainer.fit(module, datamodule=data)
        return
    try:
        torch.load(checkpoint, weights_only=True, map_location="cpu")
    except Exception as error:  # whatever a damaged or foreign file raises
        raise NsmError(
            f"{checkpoint}: damaged, or not a checkpoint of nsm; delete it to start again"
        ) from error
    trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)


def _write_surface(folder: Path, neural: NeuralSurface) -> None:
    save_surface(folder, neural)
    vertices, faces, uv = neural.to_mesh()
    export_mesh(folder / "reconstruction.obj", vertices, faces, uv)
    export_mesh(folder / "reconstruction.glb", vertices, faces, uv, texture=checkerboard())
    error_picture(folder / "error.png", neural.surface, neural)
    checkerboard_picture(folder / "checkerboard.png", neural.surface, neural)


def _write_figures(
    folder: Path, surface: Surface, trainer: pl.Trainer, started: float, figures: dict[str, Any]
) -> None:
    words = {
        "surface": surface.name,
        "steps": trainer.global_step,
        "seconds": round(time.monotonic() - started, 2),
        "preparation": surface.quality,
        **figures,
    }
    # last of all: its presence says that the run is complete
    atomic_write(folder / "metrics.json", (json.dumps(words, indent=2) + "\n").encode())


def _into_square(uv: np.ndarray) -> np.ndarray:
    """Coordinates (V, 2) moved and scaled as a whole into [-1, 1]², where textures lie."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    return (uv - 0.5 * (low + high)) * (2 / (high - low).max())
