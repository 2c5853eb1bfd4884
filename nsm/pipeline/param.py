"""task=param: a neural surface flattened."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytorch_lightning as pl
import torch
from omegaconf import DictConfig
from rich.console import Console

from nsm.domains.baselines import BASELINES
from nsm.pipeline.certification import certified
from nsm.pipeline.common import built, frozen, plain, say_where, train, with_map, write_figures
from nsm.pipeline.surface_cache import neural_surface
from nsm.results import (
    NeuralSurface,
    Parameterization,
    checkerboard,
    comparison_table,
    export_mesh,
    layout_image,
    parameterization_picture,
    planar_metrics,
)
from nsm.results.callbacks import Pictures
from nsm.surfaces.topology import face_areas
from nsm.tasks import Param


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
    console = Console(highlight=False, markup=False)
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
    trainer = train(config, folder, surface, module, console, pictures, resuming=resuming)

    def made() -> Parameterization:
        return Parameterization(phi, frozen(module.map), {}, plain(config))

    result, certificate = certified(config, trainer, module, made, console)
    maps = {"domain": surface.uv, "nsm": result.uv}
    for name, method in BASELINES.items():
        try:
            maps[f"{name} (libigl)"] = method(surface.vertices, surface.faces, surface.uv)
        except RuntimeError as error:
            console.print(f"  {name} of libigl failed: {error}")
    for name, uv in maps.items():
        result.metrics[name] = planar_metrics(surface.vertices, surface.faces, uv)
    result.metrics["nsm"].update(result.certificate)

    result.save(folder)
    if config.artefacts:
        _write_artefacts(folder, result)
    figures = {**certificate, "metrics": result.metrics}
    write_figures(config, folder, surface, trainer, started, figures)
    console.print(comparison_table(result.metrics))
    ours = result.metrics["nsm"]
    if ours["flipped_percent"] == 0 and ours["boundary_self_intersections"]:
        console.print(
            "nothing is flipped, but the image overlaps itself; constraints.boundary=fixed forbids"
        )
    say_where(console, folder)
    return result


def _write_artefacts(folder: Path, result: Parameterization) -> None:
    surface = result.phi.surface
    inside = _into_square(result.uv)
    for ending, texture in (("obj", None), ("glb", checkerboard())):
        file = folder / f"parameterized.{ending}"
        export_mesh(file, surface.vertices, surface.faces, inside, texture=texture)
    picture_file = folder / "checkerboard.png"
    before_after = {"before: domain Ω": surface.uv, "after": result.uv}
    parameterization_picture(picture_file, surface, before_after)


def build_param(config: DictConfig, phi: NeuralSurface) -> Param:
    """The param task's module, seeded.

    Raises:
        NsmError: settings of the network, energy, optimiser or schedule that do not fit together.
    """
    surface = phi.surface
    mesh = (
        torch.as_tensor(surface.uv, dtype=torch.float32),
        torch.as_tensor(surface.faces),
        torch.as_tensor(face_areas(surface.vertices, surface.faces), dtype=torch.float32),
    )
    return built(
        config,
        lambda common: Param(
            **with_map(common),
            domain=config.domain,
            weights={name: float(w) for name, w in config.energy.weights.items()},
            **common["constraints"],
            mesh=mesh,
            phi=phi.map,
        ),
    )


def _into_square(uv: np.ndarray) -> np.ndarray:
    """Coordinates (V, 2) moved and scaled as a whole into [-1, 1]², where textures lie."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    return (uv - 0.5 * (low + high)) * (2 / (high - low).max())
