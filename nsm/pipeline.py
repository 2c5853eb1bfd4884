"""From a checked configuration to a run folder with results."""

from __future__ import annotations

import json
import logging
import os
import time
import warnings
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.callbacks import Callback, LearningRateMonitor
from pytorch_lightning.loggers import TensorBoardLogger
from rich.console import Console

from nsm.config import checked
from nsm.data import OverfitData
from nsm.errors import NsmError
from nsm.results import (
    NeuralSurface,
    atomic_write,
    checkerboard,
    checkerboard_picture,
    error_picture,
    export_mesh,
    metrics_table,
    overfit_metrics,
    save_surface,
)
from nsm.results.callbacks import AtomicCheckpoint, GradientWatch, Pictures
from nsm.results.progress import TrainingProgress
from nsm.surfaces import Surface
from nsm.tasks import Overfit

CONFIG_FILE = "config.yaml"
CHECKPOINT_FILE = "last.ckpt"


def run(config: DictConfig, folder: Path) -> None:
    """Run the task of a configuration in a folder.

    Raises:
        NsmError: bad input of any kind.
    """
    tasks = {"overfit": run_overfit}
    if config.task.name not in tasks:
        raise NsmError(f"task.name={config.task.name} is not one of {', '.join(tasks)}")
    tasks[config.task.name](config, folder)


def run_overfit(config: DictConfig, folder: Path, surface: Surface | None = None) -> NeuralSurface:
    """Overfit one surface, and leave all of its results in the folder.

    Args:
        config: as :func:`nsm.config.compose_config` gives it. With ``resume`` set, the folder's
            own configuration takes its place, and the training goes on from its checkpoint.
        folder: the run folder.
        surface: the surface, where it is at hand; else it is loaded as configured.

    Raises:
        NsmError: a mesh, setting or run folder that cannot be used.
    """
    console = Console(highlight=False)
    checkpoint = None
    if config.resume is not None:
        config = _stored_config(folder)
        checkpoint = folder / CHECKPOINT_FILE
        if not checkpoint.is_file():
            checkpoint = None  # killed before the first one: the same run from its start
    started = time.monotonic()
    if surface is None:
        surface = _load_surface(config)
    _report_surface(console, surface)
    module = build_overfit(config, surface)
    data = OverfitData(
        surface,
        **OmegaConf.to_container(config.data),
        seed=config.seed,  # type: ignore[arg-type]
    )
    trainer = _trainer(config, folder, surface, console)
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write(folder / CONFIG_FILE, OmegaConf.to_yaml(config).encode())
    _fit(trainer, module, data, checkpoint)
    if trainer.interrupted:
        console.print(f"interrupted; go on with: nsm resume={folder}")
        raise KeyboardInterrupt
    seconds = time.monotonic() - started

    phi = module.map.cpu().eval().requires_grad_(False)
    metrics = overfit_metrics(surface, phi)
    neural = NeuralSurface(
        surface=surface,
        map=phi,
        metrics=metrics,
        config=OmegaConf.to_container(config),  # type: ignore[arg-type]
    )
    _write_results(folder, neural, steps=trainer.global_step, seconds=seconds)
    console.print(metrics_table(metrics))
    console.print(f"results in {folder}", soft_wrap=True)
    return neural


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
        f"{surface.quality['median_symmetric_dirichlet']:.2f}"
    )
    for line in surface.log:
        console.print(f"  {line}")


def build_overfit(config: DictConfig, surface: Surface) -> Overfit:
    """The task's module, seeded.

    Raises:
        NsmError: settings of the network, optimiser or schedule that do not fit together.
    """
    pl.seed_everything(config.seed, verbose=False)
    network: dict[str, Any] = {
        "out_dim": 3,
        **OmegaConf.to_container(config.map),  # type: ignore[dict-item]
        "activation": OmegaConf.to_container(config.activation),
        "encoding": OmegaConf.to_container(config.encoding),
    }
    try:
        module = Overfit(
            map=network,
            optimizer=OmegaConf.to_container(config.optimizer),  # type: ignore[arg-type]
            scheduler=OmegaConf.to_container(config.scheduler),  # type: ignore[arg-type]
            lambda_normal=config.energy.lambda_normal,
            max_steps=config.trainer.max_steps,
            diagonal=surface.bounding_box_diagonal,
        )
        module.configure_optimizers()  # settings that do not fit are told before any work
    except (ValueError, TypeError, KeyError) as error:
        raise NsmError(f"setting: {' '.join(str(error).split())}") from error
    return module


def _trainer(config: DictConfig, folder: Path, surface: Surface, console: Console) -> pl.Trainer:
    settings = config.trainer
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    callbacks: list[Callback] = [
        GradientWatch(config.logger.every, settings.stop_gradient_norm, settings.stop_window),
        AtomicCheckpoint(folder / CHECKPOINT_FILE),
    ]
    if settings.progress:
        callbacks.append(TrainingProgress(console, f"overfit {surface.name}"))
    logger: TensorBoardLogger | bool = False
    if config.logger.tensorboard:
        logger = TensorBoardLogger(save_dir=folder, name="", version="tensorboard")
        callbacks += [LearningRateMonitor(), Pictures(surface, config.logger.pictures)]
    quiet_lightning()
    try:
        return pl.Trainer(
            accelerator=settings.accelerator,
            devices=1,
            max_steps=settings.max_steps,
            max_epochs=-1,
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
        raise NsmError(f"setting trainer.accelerator={settings.accelerator}: {reason}") from error


def quiet_lightning() -> None:
    """Leave out Lightning's remarks on data loaders and hardware: they do not concern samples that
    are made on the device."""
    logging.getLogger("pytorch_lightning").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="pytorch_lightning")
    warnings.filterwarnings("ignore", module="lightning_fabric")


def _fit(trainer: pl.Trainer, module: Overfit, data: OverfitData, checkpoint: Path | None) -> None:
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


def _write_results(folder: Path, neural: NeuralSurface, *, steps: int, seconds: float) -> None:
    save_surface(folder, neural)
    vertices, faces, uv = neural.to_mesh()
    export_mesh(folder / "reconstruction.obj", vertices, faces, uv)
    export_mesh(folder / "reconstruction.glb", vertices, faces, uv, texture=checkerboard())
    error_picture(folder / "error.png", neural.surface, neural)
    checkerboard_picture(folder / "checkerboard.png", neural.surface, neural)
    figures = {
        "surface": neural.surface.name,
        "steps": steps,
        "seconds": round(seconds, 2),
        "preparation": neural.surface.quality,
        "metrics": neural.metrics,
    }
    # last of all: its presence says that the run is complete
    atomic_write(folder / "metrics.json", (json.dumps(figures, indent=2) + "\n").encode())
