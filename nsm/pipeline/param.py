"""task=param: a neural surface flattened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from nsm.data import SurfaceData
from nsm.domains.baselines import BASELINES
from nsm.maps import Remembered
from nsm.pipeline.surface_cache import neural_surface
from nsm.pipeline.task import Given, Task, frozen
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
from nsm.results.patterns import write_patterns
from nsm.surfaces.topology import face_areas
from nsm.tasks import Param


class ParamTask(Task):
    """A map of a neural surface to the plane, with least distortion, beside libigl's methods."""

    module, data, result, defaults = Param, SurfaceData, Parameterization, "param"
    certified = True
    table = staticmethod(comparison_table)
    picture_name = "layout"

    def inputs(self, given: Given) -> list[Any]:
        ready = self.config.phi.path if given.phi is None else given.phi
        return [] if ready is None else [ready]

    def prepare(self, given: Given) -> None:
        phi = given.phi
        if not isinstance(phi, NeuralSurface):
            phi = neural_surface(self.config, self.console, phi)
        self.use(phi)

    def use(self, phi: NeuralSurface) -> None:
        """Take the neural surface."""
        self.choose_domain(Given(phi=phi))
        self.phi, self.surface = phi, phi.surface

    def build(self) -> Any:
        surface = self.surface
        areas = face_areas(surface.vertices, surface.faces)
        mesh = (
            torch.as_tensor(surface.uv, dtype=torch.float32),
            torch.as_tensor(surface.faces),
            torch.as_tensor(areas, dtype=torch.float32),
        )
        return self.module(**self.map_settings(), mesh=mesh, phi=self._for_training())

    def _for_training(self) -> torch.nn.Module:
        """φ as the training evaluates it."""
        kept = self.config.trainer.tabulated is not None
        return Remembered(self.phi.map) if kept else self.phi.map

    def make_result(self, module: Any) -> Parameterization:
        return Parameterization(self.phi, frozen(module.map), {}, self.settings)

    def measure(self, result: Parameterization) -> None:
        surface = self.surface
        maps = {"domain": surface.uv, "nsm": result.uv}
        for name, method in BASELINES.items():
            try:
                maps[f"{name} (libigl)"] = method(surface.vertices, surface.faces, surface.uv)
            except RuntimeError as error:
                self.console.print(f"  {name} of libigl failed: {error}")
        for name, uv in maps.items():
            result.metrics[name] = planar_metrics(surface.vertices, surface.faces, uv)
        result.metrics["nsm"].update(result.certificate)

    def picture(self, module: Any) -> np.ndarray:
        uv = module(torch.as_tensor(self.surface.uv, dtype=torch.float32, device=module.device))
        image = layout_image(self.surface, uv.detach().cpu().double().numpy())
        return np.round(255 * image).astype(np.uint8)

    def write_artefacts(self, folder: Path, result: Parameterization) -> None:
        surface = self.surface
        inside = _into_square(result.uv)
        for ending, texture in (("obj", None), ("glb", checkerboard())):
            file = folder / f"parameterized.{ending}"
            export_mesh(file, surface.vertices, surface.faces, inside, texture=texture)
        write_patterns(folder / "pattern", result.uv / surface.scale, surface.faces)
        before_after = {"before: domain Ω": surface.uv, "after": result.uv}
        parameterization_picture(folder / "checkerboard.png", surface, before_after)


def _into_square(uv: np.ndarray) -> np.ndarray:
    """Coordinates (V, 2) moved and scaled as a whole into [-1, 1]², where textures lie."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    return (uv - 0.5 * (low + high)) * (2 / (high - low).max())
