"""Neural surfaces that maps need: each is made once, and kept in the cache."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from omegaconf import DictConfig, open_dict
from rich.console import Console

from nsm.config import compose_config
from nsm.domains import Domain, Surface, domain
from nsm.errors import NsmError
from nsm.maps.networks import SKIPS
from nsm.pipeline.batched import common_settings, member, overfit_ensemble
from nsm.pipeline.checkpoints import CHECKPOINT_FILE
from nsm.pipeline.configured_surface import configured_surface, report_surface
from nsm.pipeline.runner import finish, made_line, run_prepared
from nsm.pipeline.training import Run, accelerator_of, plain
from nsm.results import NeuralSurface, load_surface
from nsm.run_directories import temporary_folder
from nsm.side_by_side import at_once, side_by_side
from nsm.stages import stage
from nsm.surfaces.cache import cache_folder
from nsm.sweeps import is_complete
from nsm.tasks.ensemble import EnsembleSplit

# to be raised when the same settings come to make another neural surface
_VERSION = 4

# settings that make a neural surface what it is; those of the trainer but for how it is run
_ESSENTIAL = (
    "task",
    "domain",
    "map",
    "activation",
    "encoding",
    "loss_weights",
    "loss_terms",
    "sampler",
    "data",
    "optimizer",
    "scheduler",
    "callbacks",
    "trainer",
    "seed",
)
# settings with which a map's surfaces are not those of experiment=fit
_OF_THE_FIT = ("experiment", "encoding", "map", "trainer.max_steps")
_HARDWARE = (
    "accelerator",
    "devices",
    "threads",
    "progress",
    "compile",
    "log_every",
    "log_pictures",
    "log_meshes",
    "log_histograms",
)


def neural_surface(config: DictConfig, console: Console, given: Any = None) -> NeuralSurface:
    """The neural surface that a map's configuration names, made if it is not there yet.

    Args:
        given: in its place, a mesh as :meth:`Surface.load` takes it, or a prepared surface.

    Raises:
        NsmError: a mesh, neural surface or setting that cannot be used.
    """
    if given is None and config.phi.path is not None:
        phi = load_surface(config.phi.path, trust=config.trust)
        if phi.surface.domain != domain(config.domain):
            raise NsmError(
                f"{config.phi.path}: its domain is the {phi.surface.domain}, not the "
                f"{domain(config.domain)}; give domain={phi.surface.domain}",
                kind="wrong_domain",
                key="phi.path",
            )
        return phi
    surface = configured_surface(config, console, given)
    report_surface(console, surface)
    return cached_surfaces([surface], config, console)[0]


def cached_surfaces(
    surfaces: Sequence[Surface], config: DictConfig, console: Console
) -> list[NeuralSurface]:
    """The neural surfaces of prepared ones, from the cache if they were made before.

    On a GPU, those that are missing are trained in one batch, which fills it; on a CPU, side by
    side, each by a process on a core of its own.

    Args:
        surfaces: prepared and reported ones.
        config: of the map that needs them.
        console: where to print.

    Raises:
        NsmError: settings in ``phi.overrides`` that cannot be used.
    """
    with stage(console, f"neural surfaces of {', '.join(surface.name for surface in surfaces)}"):
        overfit = _overfit_config(config, surfaces[0].domain)
        settings = plain(overfit)
        kept = _cacheable(settings)
        folders = {_folder_of(one, settings): one for one in surfaces} if kept else {}
    if not kept:
        with temporary_folder() as folder:
            return [
                _made(surface, overfit, Path(folder) / str(k), console)
                for k, surface in enumerate(surfaces)
            ]
    missing = {f: surface for f, surface in folders.items() if not is_complete(f)}
    if len(missing) > 1 and accelerator_of(overfit) == "gpu":
        # those on closed domains, for instance, cannot be trained together
        if settings["trainer"]["max_steps"] and common_settings(settings) is not None:
            _fill_cache(missing, overfit, console)
    elif len(missing) > 1 and settings["trainer"]["threads"] == 1:
        _fill_side_by_side(missing, overfit, console, config.phi.get("processes"))
    return [_cached(surface, overfit, console, known=missing) for surface in surfaces]


def _cached(
    surface: Surface, overfit: DictConfig, console: Console, known: Collection[Path] = ()
) -> NeuralSurface:
    """From the cache, or made; ``known`` are folders of which it was said before that they are
    made."""
    folder = _folder_of(surface, plain(overfit))
    with FileLock(folder.with_suffix(".lock")):  # jobs of a sweep may want the same one
        if not is_complete(folder):
            return _made(surface, overfit, folder, console)
        if folder not in known:
            console.print(f"{surface.name}: neural surface taken from the cache")
        # equal in Ω, but perhaps of another file, with its own units, place and vertex numbers
        return replace(load_surface(folder), surface=surface)


def _made(surface: Surface, overfit: DictConfig, folder: Path, console: Console) -> NeuralSurface:
    if overfit.trainer.threads is not None:  # for the least-squares fit too
        torch.set_num_threads(overfit.trainer.threads)
    run = Run(overfit, folder, resuming=(folder / CHECKPOINT_FILE).exists(), inner=True)
    started, one = time.monotonic(), member(run, surface, console)
    phi: NeuralSurface = run_prepared(one.task, run, started)
    return phi


def _fill_side_by_side(
    missing: dict[Path, Surface], overfit: DictConfig, console: Console, processes: int | None
) -> None:
    """Make the missing ones, several at once, each in a process on a core of its own."""
    if at_once(len(missing), processes) < 2:
        return  # one after the other shows the progress of each
    quiet = Console(quiet=True)
    titles = ", ".join(surface.name for surface in missing.values())

    def one(surface: Surface) -> Callable[[], dict[str, float]]:
        def make() -> dict[str, float]:
            started = time.monotonic()
            metrics = _cached(surface, overfit, quiet).metrics
            return {**metrics, "seconds": time.monotonic() - started}

        return make

    try:
        with stage(console, f"neural surfaces of {titles}"):
            calls = [one(surface) for surface in missing.values()]
            every = side_by_side(calls, processes)
    except KeyboardInterrupt as error:
        console.print("interrupted; the same command goes on")
        raise KeyboardInterrupt("told") from error
    for surface, metrics in zip(missing.values(), every, strict=True):
        console.print(made_line(surface.name, metrics, metrics["seconds"]), soft_wrap=True)


def _fill_cache(missing: dict[Path, Surface], overfit: DictConfig, console: Console) -> None:
    started = time.monotonic()
    with ExitStack() as locks:
        for folder in sorted(missing):  # in one order, whichever process wants them
            locks.enter_context(FileLock(folder.with_suffix(".lock")))
        left = {folder: s for folder, s in missing.items() if not is_complete(folder)}
        members = [
            member(Run(overfit, f, resuming=True, inner=True), s, console) for f, s in left.items()
        ]
        stages = {one.run.stage for one in members}
        if len(members) < 2 or len(stages) > 1 or None in stages:
            return  # what was begun alone goes on alone
        try:
            modules, trainer = overfit_ensemble(members, console)
        except EnsembleSplit as fault:
            console.print(f"{fault}; each goes on alone")
            return
        for index, (one, module) in enumerate(zip(members, modules, strict=True)):
            finish(one.task, one.run, module, trainer, started, index=index)


def _overfit_config(config: DictConfig, on: Domain) -> DictConfig:
    """The configuration with which the neural surfaces of a map are made, on a domain."""
    keys = ("accelerator", "devices", "threads", "precision", "progress")
    values = {key: config.trainer[key] for key in keys}
    overrides = [
        "task=overfit",
        "logger=none",
        "artefacts=false",
        f"seed={config.seed}",
        *(f"trainer.{key}={'null' if v is None else v}" for key, v in values.items()),
    ]
    steps = config.phi.get("steps")  # absent in older run folders
    said = {word.lstrip("+").partition("=")[0] for word in config.phi.overrides}
    alone = steps == 0 and not any(key.startswith(_OF_THE_FIT) for key in said)
    fit = ["experiment=fit"] if alone else []
    overfit = compose_config([*overrides, *fit, *config.phi.overrides])
    fitted = overfit.map.get("linear_skip") == "fitted"
    if alone and not fitted:  # a random start has to be trained
        overfit = compose_config([*overrides, *config.phi.overrides])
    elif fitted and steps is not None and "trainer.max_steps" not in said:
        overfit.trainer.max_steps = min(steps, overfit.trainer.max_steps)
    with open_dict(overfit):
        overfit.domain = on.config
    return overfit


def _cacheable(settings: dict[str, Any]) -> bool:
    """Whether settings alone make a neural surface what it is: code of nsm and torch changes with
    their versions only, a user's own at any time, under the same name."""
    known = ("nsm.", "torch.")
    own = [
        t for t in _targets(settings) if not t.startswith(known) or t.startswith("nsm.extensions")
    ]
    return not own and settings["map"]["block"] in SKIPS


def _targets(settings: Any) -> Iterator[str]:
    """All ``_target_`` in settings."""
    if isinstance(settings, dict):
        yield from [str(settings["_target_"])] if "_target_" in settings else []
        for value in settings.values():
            yield from _targets(value)
    elif isinstance(settings, list):
        for value in settings:
            yield from _targets(value)


def _folder_of(surface: Surface, settings: dict[str, Any]) -> Path:
    """Where the cache has, or will have, the neural surface of a prepared one."""
    key = {name: settings[name] for name in _ESSENTIAL}
    key["trainer"] = {k: v for k, v in key["trainer"].items() if k not in _HARDWARE}
    text = f"{_VERSION} {surface.content_key()}{json.dumps(key, sort_keys=True)}"
    folder = cache_folder() / "neural" / hashlib.sha256(text.encode()).hexdigest()[:32]
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder
