"""A small result of every kind, without training."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from nsm.domains import Surface
from nsm.maps import DiscMap, NeuralMap, PlanarMap, Rotated
from nsm.results import NeuralSurface, Parameterization, SurfaceCollection, SurfaceMap
from nsm.surfaces.shapes import ring_mesh

NETWORK = {"width": 4, "depth": 1, "block": "plain"}
# the shortest training, of the surface that is in patch.off
TRAINING = [
    "surface.path=patch.off",
    "surface.parameterization=tutte",
    "experiment=quick",
    "encoding.resolutions=[4]",
    "trainer.max_steps=4",
    "data.batch_size=64",
    "data.held_out=64",
    "artefacts=false",
    "trainer.progress=false",
]
# the same of a flattening, whose h is a spline
FLATTENING = [word for word in TRAINING if not word.startswith("encoding")]
# of maps in the tests: short, and of few samples
QUICK = [
    "experiment=quick",
    "data.steps_per_epoch=50",
    "data.batch_size=512",
    "data.held_out=512",
    "trainer.threads=1",
]


class Results(NamedTuple):
    """Three surfaces, and one map of each kind between them."""

    neural: list[NeuralSurface]
    flat: Parameterization
    pair: SurfaceMap
    trio: SurfaceCollection


def stirred(module: torch.nn.Module) -> torch.nn.Module:
    """A network with its weights moved a little, and frozen; planar maps stay injective."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(parameter + 0.05 * torch.randn(parameter.shape, generator=generator))
    return module.eval().requires_grad_(False)


def planar(kind: type[PlanarMap] | type[DiscMap] = DiscMap) -> torch.nn.Module:
    """A map of the plane that is near the identity."""
    return stirred(kind(NeuralMap(out_dim=kind.network_out_dim, **NETWORK)))


def dome(height: float, rings: int) -> Surface:
    """A cap over the disc, of that many rings of triangles."""
    uv, faces = ring_mesh(rings)
    z = height * (1 - (uv**2).sum(axis=1))
    return Surface.from_arrays(np.column_stack([uv, z]), faces, name=f"dome {height}")


def results(rings: int) -> Results:
    """The results, on domes of that many rings of triangles."""
    neural = [
        NeuralSurface(
            dome(0.2 * (k + 1), rings),
            stirred(NeuralMap(out_dim=3, **NETWORK)),
            {"rms_percent": 1.0},
            {"seed": k},
        )
        for k in range(3)
    ]
    h = [Rotated(planar(), torch.eye(2)) for _ in neural]
    return Results(
        neural,
        Parameterization(neural[0], planar(PlanarMap)),
        SurfaceMap(neural[0], neural[1], h[0], np.array([[0, 0], [5, 6]])),
        SurfaceCollection(neural, h, np.array([[0, 0, 0]])),
    )
