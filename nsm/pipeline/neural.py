"""Neural surfaces that maps are made of: each is made once, and kept in the cache."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import pytorch_lightning as pl
from filelock import FileLock
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from nsm.config import compose_config
from nsm.data import SeveralData
from nsm.errors import NsmError
from nsm.maps import NeuralMap
from nsm.pipeline.common import (
    CHECKPOINT_FILE,
    CONFIG_FILE,
    built,
    configured_surface,
    fitted,
    frozen,
    plain,
    with_map,
    write_figures,
)
from nsm.pipeline.overfit import run_overfit
from nsm.results import NeuralSurface, load_surface, overfit_metrics, save_surface
from nsm.results.files import atomic_write
from nsm.surfaces import Surface
from nsm.surfaces.cache import cache_folder
from nsm.tasks import OverfitSeveral
from nsm.tasks.least_squares import fit_readout

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
    return _made(surface, _settings_of_phi(config), console)


def _made(surface: Surface, overfit: DictConfig, console: Console) -> NeuralSurface:
    folder = _place_of(surface, overfit)
    with FileLock(folder.with_suffix(".lock")):  # jobs of a sweep may want the same one
        if (folder / "metrics.json").exists():
            console.print(f"{surface.name}: neural surface taken from the cache")
            return load_surface(folder)
        return run_overfit(overfit, folder, surface, resuming=(folder / CHECKPOINT_FILE).exists())


def made_together(
    surfaces: Sequence[Surface], config: DictConfig, console: Console, *, in_one_batch: bool
) -> list[NeuralSurface]:
    """As :func:`made_once` of each.

    Args:
        surfaces: prepared ones.
        config: of the map that wants them.
        console: told what is done.
        in_one_batch: train those that are not in the cache together, which fills a GPU; a CPU is
            as fast with one after the other, and keeps more if it is interrupted.

    Raises:
        NsmError: settings in ``phi.overrides`` that cannot be used.
    """
    overfit = _settings_of_phi(config)
    limits = (overfit.trainer.stop_gradient_norm, overfit.trainer.gradient_clip)
    # these look at a whole training's gradient, where each surface needs its own
    if in_one_batch and limits == (None, None):
        places = {_place_of(surface, overfit): surface for surface in surfaces}
        missing = {p: s for p, s in places.items() if not (p / "metrics.json").exists()}
        # what was begun alone goes on alone
        if len(missing) > 1 and not any((p / CHECKPOINT_FILE).exists() for p in missing):
            _fill_cache(missing, overfit, console)
    return [_made(surface, overfit, console) for surface in surfaces]


def _fill_cache(missing: dict[Path, Surface], overfit: DictConfig, console: Console) -> None:
    started = time.monotonic()
    names = " ".join(sorted(folder.name for folder in missing))
    common = (
        cache_folder() / "neural" / f"several-{hashlib.sha256(names.encode()).hexdigest()[:32]}"
    )
    surfaces = list(missing.values())
    with FileLock(common.with_suffix(".lock")):
        if all((folder / "metrics.json").exists() for folder in missing):
            return  # another process has made them
        module, trainer = _trained_together(overfit, common, surfaces, console)
        for (folder, surface), network in zip(missing.items(), module.maps, strict=True):
            phi = frozen(network)
            neural = NeuralSurface(surface, phi, overfit_metrics(surface, phi), plain(overfit))
            with FileLock(folder.with_suffix(".lock")):
                save_surface(folder, neural)
                atomic_write(folder / CONFIG_FILE, OmegaConf.to_yaml(overfit).encode())
                figures = {"together": len(missing), "metrics": neural.metrics}
                write_figures(overfit, folder, surface, trainer, started, figures)
            console.print(f"{surface.name}: RMS error {neural.metrics['rms_percent']:.3f} %")
        shutil.rmtree(common)


def _trained_together(
    config: DictConfig, folder: Path, surfaces: Sequence[Surface], console: Console
) -> tuple[OverfitSeveral, pl.Trainer]:
    def make(common: dict[str, Any]) -> OverfitSeveral:
        module = OverfitSeveral(
            seed=config.seed,
            **with_map(common, out_dim=3),
            lambda_normal=float(config.energy.lambda_normal),
            diagonals=[surface.bounding_box_diagonal for surface in surfaces],
        )
        if config.map.readout == "fitted":
            for network, surface in zip(module.maps, surfaces, strict=True):
                fit_readout(cast(NeuralMap, network), surface, seed=config.seed)
        return module

    module = built(config, make)
    trainer = fitted(
        config,
        folder,
        SeveralData(surfaces, **plain(config)["data"], seed=config.seed),
        module,
        console,
        None,
        f"overfit {len(surfaces)} surfaces",
        resuming=(folder / CHECKPOINT_FILE).exists(),
    )
    return module, trainer


def _settings_of_phi(config: DictConfig) -> DictConfig:
    """The settings that the neural surfaces of a map are made with."""
    words = [
        "task=overfit",
        "logger=none",
        "artefacts=false",
        f"domain={config.domain}",
        f"seed={config.seed}",
    ]
    words += [
        f"trainer.progress={str(config.trainer.progress).lower()}",
        f"trainer.devices={config.trainer.devices}",
    ]
    return compose_config([*words, *config.phi.overrides])


def _place_of(surface: Surface, overfit: DictConfig) -> Path:
    """Where the cache has, or will have, the neural surface of a prepared one."""
    settings = {k: v for k, v in plain(overfit).items() if k not in _INCIDENTAL}
    for key in ("progress", "compile", "devices"):
        settings["trainer"].pop(key)
    text = surface.content_key() + json.dumps(settings, sort_keys=True)
    folder = cache_folder() / "neural" / hashlib.sha256(text.encode()).hexdigest()[:32]
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder
