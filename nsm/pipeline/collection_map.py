"""task=collection_map: several surfaces put into correspondence, every one with every other."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from omegaconf import DictConfig
from rich.console import Console

from nsm.data import CollectionData
from nsm.domains import bounded
from nsm.domains.joint_preparation import Matched, matched_landmarks
from nsm.errors import NsmError
from nsm.pipeline.certification import certified
from nsm.pipeline.common import built, fitted, frozen, plain, say_where, with_map, write_figures
from nsm.pipeline.pair_map import absolute_paths
from nsm.pipeline.resolve_inputs import landmark_vertices, neural_surfaces, read_shape
from nsm.results import (
    NeuralSurface,
    SurfaceCollection,
    by_file_vertex,
    checkerboard,
    collection_metrics,
    collection_table,
    export_mesh,
    figures_picture,
    map_image,
    transfer_matrix_picture,
)
from nsm.results.callbacks import Pictures
from nsm.results.metrics import evaluate
from nsm.tasks import CollectionMap
from nsm.tasks.initial_rotation import landmark_rotation, least_distorting_rotation

_SEAM_POINTS = 24  # on each branch
_RINGS = 80  # of an even mesh of the common domain


def run_collection_map(
    config: DictConfig,
    folder: Path,
    surfaces: Sequence[Any] | None = None,
    landmarks: Any = None,
    *,
    resuming: bool = False,
) -> SurfaceCollection:
    """Put surfaces into correspondence, and leave all results in the folder.

    Args:
        config: as :func:`nsm.config.compose_config` gives it, with ``task=collection_map``.
        folder: the run folder.
        surfaces: three or more, as :func:`nsm.pipeline.resolve_inputs.read_shape` takes them;
            those of the configuration by default.
        landmarks: as :func:`nsm.pipeline.resolve_inputs.landmark_vertices` takes them.
        resuming: go on from the folder's checkpoint.

    Raises:
        NsmError: a surface, landmark, setting or run folder that cannot be used.
    """
    console = Console(highlight=False, markup=False)
    started = time.monotonic()
    for key in ("surfaces", "landmarks"):
        config[key] = absolute_paths(config[key])  # resuming works from any folder
    settings = plain(config)
    given = settings["surfaces"] if surfaces is None else surfaces
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) < 3:
        raise NsmError("setting surfaces: a collection needs three surfaces or more, as a list")
    shapes = [read_shape(word, config.domain, f"surfaces[{k}]") for k, word in enumerate(given)]
    ids = landmark_vertices(settings["landmarks"] if landmarks is None else landmarks, shapes)
    phis = neural_surfaces(config, shapes, ids, console)
    matched = matched_landmarks([phi.surface for phi in phis], ids)
    module, points, turns = build_collection_map(config, phis, matched)
    data = CollectionData(
        [phi.surface for phi in phis], turns, **settings["data"], seed=config.seed
    )
    first, last = phis[0].surface, phis[-1].surface

    def picture(m: pl.LightningModule) -> np.ndarray:
        maps = [h.to("cpu") for h in m.map]  # type: ignore[union-attr]
        # where the vertices of the first go if h_0 is taken for its start
        uv = evaluate(maps[-1], first.uv @ maps[0].rotation.double().numpy())
        return map_image(first, last, uv)

    trainer = fitted(
        config,
        folder,
        data,
        module,
        console,
        Pictures("map", picture, config.logger.pictures),
        f"collection_map of {len(phis)} surfaces",
        resuming=resuming,
    )

    def made() -> SurfaceCollection:
        maps = [frozen(h) for h in module.map]
        return SurfaceCollection(phis, maps, np.stack(ids, axis=1), {}, settings)

    result, certificate = certified(config, trainer, module, made, console)
    result.metrics.update(collection_metrics(result, points, matched.points))
    result.save(folder)
    if config.artefacts:
        _write_artefacts(folder, result)
    names = [phi.surface.name for phi in phis]
    figures = {
        "surfaces": names,
        "landmarks": len(ids[0]),
        **certificate,
        "metrics": result.metrics,
    }
    write_figures(config, folder, first, trainer, started, figures)
    console.print(collection_table(result.metrics))
    say_where(console, folder)
    return result


def build_collection_map(
    config: DictConfig, phis: Sequence[NeuralSurface], matched: Matched
) -> tuple[CollectionMap, np.ndarray, torch.Tensor]:
    """The collection_map task's module, seeded; its common landmarks (K, 2); rotations (k, 2, 2).

    The common domain is that of the first surface, but for the landmarks, which lie in the middle
    of where the surfaces have them.

    Raises:
        NsmError: settings of the network, energy, optimiser or schedule that do not fit together.
    """
    targets = torch.as_tensor(np.stack(matched.points), dtype=torch.float32)
    uv = torch.as_tensor(phis[0].surface.uv, dtype=torch.float32)
    some = uv[:: len(uv) // 4096 + 1]
    turns = torch.stack(
        [
            torch.eye(2)
            if k == 0
            else landmark_rotation(config.domain, targets[0], targets[k])
            if targets.shape[1]
            else least_distorting_rotation(config.domain, phis[0].map, phi.map, some)
            for k, phi in enumerate(phis)
        ]
    )
    points = (targets @ turns).mean(dim=0)  # each turned back, R⁻¹ = Rᵀ
    on_boundary = points[: matched.on_boundary]
    points[: matched.on_boundary] = bounded(config.domain).to_boundary(on_boundary)
    # no h_i may fold a triangle of any surface, as F_{i→j} takes those of i through h_j; nor fold
    # anywhere between them, where samples are rare, or its inverse would be lost
    even, even_faces = bounded(config.domain).mesh(_RINGS)
    vertices = [
        torch.as_tensor(phi.surface.uv, dtype=torch.float32) @ turn
        for phi, turn in zip(phis, turns, strict=True)
    ]
    vertices.append(torch.as_tensor(even, dtype=torch.float32))
    first = np.cumsum([0, *(len(v) for v in vertices[:-1])])
    parts = [*(phi.surface.faces for phi in phis), even_faces]
    faces = np.concatenate([part + n for part, n in zip(parts, first, strict=True)])
    mesh = (torch.cat(vertices), torch.as_tensor(faces))
    cut = all(len(phi.surface.seam_pairs) for phi in phis) and matched.on_boundary >= 2
    common = Matched([points.double().numpy()], matched.numbers, matched.on_boundary)
    seam = common.seam(bounded(config.domain), _SEAM_POINTS) if cut else np.zeros((0, 2, 2))
    module = built(
        config,
        lambda settings: CollectionMap(
            **with_map(settings),
            domain=config.domain,
            weights={name: float(w) for name, w in config.energy.weights.items()},
            constraints=settings["constraints"],
            points=points,
            targets=targets,
            seam=torch.as_tensor(seam, dtype=torch.float32),
            turns=turns,
            mesh=mesh,
            diagonals=[phi.surface.bounding_box_diagonal for phi in phis],
            phis=[phi.map for phi in phis],
        ),
    )
    return module, points.double().numpy(), turns


def _write_artefacts(folder: Path, collection: SurfaceCollection) -> None:
    figures_picture(folder / "figures.png", collection)
    transfer_matrix_picture(folder / "transfer.png", collection)
    for i, source in enumerate(collection.surfaces):
        for j, target in enumerate(collection.surfaces):
            if i == j:
                continue
            f = collection.pair(i, j)
            place = folder / f"{i}_to_{j}"
            place.mkdir(exist_ok=True)
            s, t = source.surface, target.surface
            image = target.in_original_units(f.image)
            np.save(place / "mapped_vertices.npy", by_file_vertex(s, image))
            export_mesh(
                place / "target_with_source_uv.glb",
                target.in_original_units(t.vertices),
                t.faces,
                f.source_uv,
                texture=checkerboard(),
            )
