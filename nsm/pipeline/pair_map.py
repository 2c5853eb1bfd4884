"""task=pair_map: a map from one surface to another."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from nsm.domains import bounded
from nsm.domains.joint_preparation import Matched, matched_landmarks
from nsm.pipeline.attributes import read_attributes, write_transferred
from nsm.pipeline.certification import certified
from nsm.pipeline.common import built, frozen, plain, say_where, train, with_map, write_figures
from nsm.pipeline.resolve_inputs import landmark_vertices, neural_surfaces, read_shape, vertex_count
from nsm.results import (
    NeuralSurface,
    SurfaceMap,
    by_file_vertex,
    checkerboard,
    distortion_picture,
    export_mesh,
    map_image,
    morph_pictures,
    pair_metrics,
    pair_table,
    transfer_picture,
)
from nsm.results.callbacks import Pictures
from nsm.results.metrics import evaluate
from nsm.tasks import PairMap
from nsm.tasks.initial_rotation import landmark_rotation, least_distorting_rotation

_MORPH_FRAMES = 9


def run_pair_map(
    config: DictConfig,
    folder: Path,
    source: Any = None,
    target: Any = None,
    landmarks: Any = None,
    *,
    resuming: bool = False,
) -> SurfaceMap:
    """Map one surface to another, and leave all results in the folder.

    Args:
        config: as :func:`nsm.config.compose_config` gives it, with ``task=pair_map``.
        folder: the run folder.
        source, target: surfaces as :func:`nsm.pipeline.resolve_inputs.read_shape` takes them;
            those of the configuration by default.
        landmarks: as :func:`nsm.pipeline.resolve_inputs.landmark_vertices` takes them.
        resuming: go on from the folder's checkpoint.

    Raises:
        NsmError: a surface, landmark, setting or run folder that cannot be used.
    """
    console = Console(highlight=False, markup=False)
    started = time.monotonic()
    for key in ("source", "target", "landmarks"):
        config[key] = absolute_paths(config[key])  # resuming works from any folder
    for key in ("source", "target"):
        config.attributes[key] = absolute_paths(config.attributes[key])
    settings = plain(config)
    shapes = [
        read_shape(settings[key] if given is None else given, config.domain, key)
        for key, given in (("source", source), ("target", target))
    ]
    ids = landmark_vertices(settings["landmarks"] if landmarks is None else landmarks, shapes)
    attributes = read_attributes(settings["attributes"], [vertex_count(s) for s in shapes])
    phi, psi = neural_surfaces(config, shapes, ids, console)
    matched = matched_landmarks([phi.surface, psi.surface], ids)
    module = build_pair_map(config, phi, psi, matched)
    points, targets = matched.points

    def picture(m: pl.LightningModule) -> np.ndarray:
        return map_image(phi.surface, psi.surface, evaluate(m, phi.surface.uv))

    trainer = train(
        config,
        folder,
        phi.surface,
        module,
        console,
        Pictures("map", picture, config.logger.pictures),
        resuming=resuming,
        title=f"{phi.surface.name} → {psi.surface.name}",
    )

    def made() -> SurfaceMap:
        return SurfaceMap(phi, psi, frozen(module.map), np.stack(ids, axis=1), {}, settings)

    result, certificate = certified(config, trainer, module, made, console)
    landed = result.planar(points) if len(points) else points
    result.metrics.update(pair_metrics(phi.surface, psi.surface, result.image_uv, landed, targets))
    result.metrics.update(result.certificate)
    result.save(folder)
    if config.artefacts:
        _write_artefacts(folder, result)
    write_transferred(attributes, settings["attributes"], folder, result)
    write_figures(
        config,
        folder,
        phi.surface,
        trainer,
        started,
        {
            "target": psi.surface.name,
            "landmarks": len(ids[0]),
            **certificate,
            "metrics": result.metrics,
        },
    )
    console.print(pair_table(result.metrics))
    say_where(console, folder)
    return result


def build_pair_map(
    config: DictConfig, phi: NeuralSurface, psi: NeuralSurface, matched: Matched
) -> PairMap:
    """The pair_map task's module, seeded.

    Raises:
        NsmError: settings of the network, energy, optimiser or schedule that do not fit together.
    """
    surface = phi.surface
    # where the seams correspond, both sides of the source's should go to one curve
    alike = len(psi.surface.seam_pairs) and matched.on_boundary >= 2
    seam_pairs = surface.seam_pairs if alike else surface.seam_pairs[:0]
    p, q, uv, seam = (
        torch.as_tensor(array, dtype=torch.float32)
        for array in (*matched.points, surface.uv, surface.uv[seam_pairs])
    )
    if len(p):
        turn = landmark_rotation(config.domain, p, q)
    else:
        some = uv[:: len(uv) // 4096 + 1]
        turn = least_distorting_rotation(config.domain, phi.map, psi.map, some)
    if len(bounded(config.domain).corners) and config.constraints["boundary"] == "penalty":
        # the exact boundary keeps corners by construction; here they are key points (METHOD)
        corners = torch.from_numpy(bounded(config.domain).corners).to(p)
        p, q = torch.cat([p, corners]), torch.cat([q, corners @ turn.T])
    return built(
        config,
        lambda common: PairMap(
            **with_map(common),
            domain=config.domain,
            weights={name: float(w) for name, w in config.energy.weights.items()},
            constraints=common["constraints"],
            points=p,
            targets=q,
            seam=seam,
            turn=turn,
            mesh=(uv, torch.as_tensor(surface.faces)),
            diagonal=psi.surface.bounding_box_diagonal,
            phi=phi.map,
            psi=psi.map,
        ),
    )


def _write_artefacts(folder: Path, f: SurfaceMap) -> None:
    s, t = f.source.surface, f.target.surface
    image = f.target.in_original_units(f.image)
    np.save(folder / "mapped_vertices.npy", by_file_vertex(s, image))
    meshes = {
        "mapped": (image, s.faces, s.uv),
        "target_with_source_uv": (f.target.in_original_units(t.vertices), t.faces, f.source_uv),
        "source_with_target_uv": (f.source.in_original_units(s.vertices), s.faces, f.image_uv),
    }
    for name, mesh in meshes.items():
        export_mesh(folder / f"{name}.obj", *mesh)
        export_mesh(folder / f"{name}.glb", *mesh, texture=checkerboard())
    (folder / "morph").mkdir(exist_ok=True)
    for k in range(_MORPH_FRAMES):
        vertices = f.morph(k / (_MORPH_FRAMES - 1))
        export_mesh(folder / "morph" / f"{k:02d}.obj", vertices, s.faces, s.uv)
    transfer_picture(folder / "transfer.png", f)
    distortion_picture(folder / "distortion.png", f)
    morph_pictures(folder / "morph.png", folder / "morph.gif", f)


def absolute_paths(given: Any) -> Any:
    """A setting with each path in it that exists made absolute."""
    if isinstance(given, str):
        return os.path.abspath(given) if Path(given).exists() else given
    if OmegaConf.is_list(given) or (isinstance(given, Sequence)):
        return [absolute_paths(item) for item in given]
    return given
