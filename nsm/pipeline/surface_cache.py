"""Neural surfaces that maps are made of: each is made once, and kept in the cache."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from filelock import FileLock
from omegaconf import DictConfig
from rich.console import Console

from nsm.config import compose_config
from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.pipeline.common import CHECKPOINT_FILE, Run, configured_surface, plain, report_surface
from nsm.pipeline.overfit import common_settings, leave_results, overfit_ensemble, overfitted
from nsm.results import NeuralSurface, load_surface
from nsm.surfaces.cache import cache_folder
from nsm.sweeps import is_complete
from nsm.tasks.ensemble import EnsembleSplit

# of how neural surfaces are made: to be raised when the same settings come to make others
_VERSION = 2

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
    "certification",
)


def neural_surface(config: DictConfig, console: Console) -> NeuralSurface:
    """The neural surface that a map's configuration names, made if it is not there yet.

    Raises:
        NsmError: a mesh, neural surface or setting that cannot be used.
    """
    if config.phi.path is not None:
        phi = load_surface(config.phi.path)
        if str(phi.surface.domain) != config.domain:
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
    report_surface(console, surface)
    return _made(surface, _settings_of_phi(config), console)


def _made(surface: Surface, overfit: DictConfig, console: Console) -> NeuralSurface:
    folder = _place_of(surface, overfit)
    with FileLock(folder.with_suffix(".lock")):  # jobs of a sweep may want the same one
        if is_complete(folder):
            console.print(f"{surface.name}: neural surface taken from the cache")
            # equal in Ω, but perhaps of another file, with its own units, place and vertex numbers
            return replace(load_surface(folder), surface=surface)
        resuming = (folder / CHECKPOINT_FILE).exists()
        started = time.monotonic()
        return overfitted(overfit, folder, surface, console, started, resuming=resuming)


def made_batched(
    surfaces: Sequence[Surface], config: DictConfig, console: Console, *, in_one_batch: bool
) -> list[NeuralSurface]:
    """As :func:`made_once` of each, but nothing is reported of the prepared ones.

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
    if in_one_batch and common_settings(plain(overfit)) is not None:
        places = {_place_of(surface, overfit): surface for surface in surfaces}
        missing = {p: s for p, s in places.items() if not is_complete(p)}
        if len(missing) > 1:
            _fill_cache(missing, overfit, console)
    return [_made(surface, overfit, console) for surface in surfaces]


def _fill_cache(missing: dict[Path, Surface], overfit: DictConfig, console: Console) -> None:
    started = time.monotonic()
    with ExitStack() as locks:
        for folder in sorted(missing):  # in one order, whoever else wants them
            locks.enter_context(FileLock(folder.with_suffix(".lock")))
        left = {folder: s for folder, s in missing.items() if not is_complete(folder)}
        runs = [Run(overfit, folder, resuming=True) for folder in left]
        if len(runs) < 2 or len({run.stage for run in runs}) > 1 or runs[0].stage is None:
            return  # what was begun alone goes on alone
        try:
            modules, trainer = overfit_ensemble(runs, list(left.values()), console)
        except EnsembleSplit as fault:
            console.print(f"{fault}; each goes on alone")
            return
        for i, (run, surface, module) in enumerate(zip(runs, left.values(), modules, strict=True)):
            leave_results(overfit, run.folder, surface, module, trainer, console, started, index=i)


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
    text = f"{_VERSION} {surface.content_key()}{json.dumps(settings, sort_keys=True)}"
    folder = cache_folder() / "neural" / hashlib.sha256(text.encode()).hexdigest()[:32]
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder
