"""task=param: a neural surface flattened."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.text import Text

from nsm.data import SurfaceData
from nsm.domains import Surface
from nsm.domains.baselines import BASELINES
from nsm.domains.embedding import GIVEN
from nsm.maps import Remembered
from nsm.pipeline.charts import neural_charts
from nsm.pipeline.surface_cache import neural_surface
from nsm.pipeline.task import Given, Task, frozen
from nsm.results import (
    NeuralSurface,
    Parameterization,
    comparison_table,
    export_surface,
    layout_image,
    parameterization_picture,
    planar_metrics,
    warning_of_misfit,
)
from nsm.results.map_metrics import flipped_percent
from nsm.results.meshes import ColouredMesh, painted
from nsm.results.metrics import evaluate
from nsm.results.parameterization import in_file_units
from nsm.results.parameterization_atlas import ParameterizationAtlas
from nsm.results.patterns import write_patterns
from nsm.stages import at
from nsm.surfaces.topology import face_areas
from nsm.tasks import Param
from nsm.tasks.least_squares import fitted_to_layout


class ParamTask(Task):
    """A map of a neural surface to the plane, with least distortion."""

    module, data, result, defaults = Param, SurfaceData, Parameterization, "param"
    certified = True
    table = staticmethod(comparison_table)
    picture_name = "layout"
    charts: Sequence[NeuralSurface] = ()  # into which given seams cut the mesh

    def inputs(self, given: Given) -> list[Any]:
        ready = self.config.phi.path if given.phi is None else given.phi
        return [] if ready is None else [ready]

    def prepare(self, given: Given) -> None:
        phi, seams = given.phi, self.settings.get("seams")  # absent in older run folders
        ready = isinstance(phi, (NeuralSurface, Surface)) or self.config.phi.path is not None
        laid_out = self.config.surface.parameterization == GIVEN
        if seams is not None or (laid_out and not ready):
            self.keep_absolute("seams")
            self.charts = neural_charts(self.config, self.console, phi, seams)
            phi = self.charts[0]
        elif not isinstance(phi, NeuralSurface):
            phi = neural_surface(self.config, self.console, phi)
        self.use(phi)

    def parts(self) -> list[Task]:
        return [self._part(phi) for phi in self.charts] if len(self.charts) > 1 else []

    def _part(self, phi: NeuralSurface) -> Task:
        part, config = ParamTask(self.name), copy.deepcopy(self.config)
        config.artefacts = False  # those of the atlas are written
        part.setup(config, self.console)
        part.use(phi)
        return part

    def joined(self, results: list[Any]) -> ParameterizationAtlas:
        return ParameterizationAtlas(results)

    def figures(self, result: Parameterization | ParameterizationAtlas) -> dict[str, Any]:
        if isinstance(result, Parameterization):
            return {}
        return {"surface": self.surface.name.rpartition("-")[0], "charts": len(result.charts)}

    def inner_line(self, result: Parameterization) -> str:
        median = result.metrics["nsm"]["symmetric_dirichlet_median"]
        return f"flattened, median symmetric Dirichlet {median:.3f}"

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
        settings = self.map_settings()
        if surface.given_uv is not None and settings["constraints"]["boundary"] != "fixed":
            settings["start"] = fitted_to_layout(surface.given_uv, surface, seed=self.config.seed)
        return self.module(**settings, mesh=mesh, phi=self._for_training())

    def _for_training(self) -> torch.nn.Module:
        """φ as the training evaluates it."""
        kept = self.config.trainer.tabulated is not None
        return Remembered(self.phi.map) if kept else self.phi.map

    def make_result(self, module: Any) -> Parameterization:
        return Parameterization(self.phi, frozen(module.map), {}, self.settings)

    def measure(self, result: Parameterization | ParameterizationAtlas) -> None:
        if isinstance(result, ParameterizationAtlas):
            return  # its charts are measured
        surface = self.surface
        maps = {**self._before, "nsm": result.uv}
        wanted = self.config.get("baselines", False)  # absent in older run folders
        for name, method in BASELINES.items() if wanted else ():
            at(name)
            try:
                maps[f"{name} (libigl)"] = method(surface.vertices, surface.faces, surface.uv)
            except RuntimeError as error:
                self.console.print(f"  {name} of libigl failed: {error}")
        for name, uv in maps.items():
            found = planar_metrics(surface.vertices, surface.faces, uv)
            result.metrics[name] = found
            if name != "nsm":  # the others are not repaired
                found["flipped_before_repair_percent"] = found["flipped_percent"]
        result.metrics["nsm"].update(result.certificate)
        if self.trained is not None:
            result.metrics["nsm"]["flipped_before_repair_percent"] = flipped_percent(
                self.trained.uv, surface.faces, mirrored=True
            )

    def warnings(self, result: Parameterization | ParameterizationAtlas) -> list[Text]:
        misfit = warning_of_misfit(
            {phi.surface.name: phi.metrics for phi in self.charts or [self.phi]}
        )
        return [] if misfit is None else [misfit]

    @property
    def _before(self) -> dict[str, np.ndarray]:
        """The layouts (V, 2) that there are before h, by name."""
        given = self.surface.given_uv
        return {"domain": self.surface.uv, **({} if given is None else {"given": given})}

    def picture(self, module: Any) -> np.ndarray:
        image = layout_image(self.surface, evaluate(module, self.surface.uv))
        return np.round(255 * image).astype(np.uint8)

    def mesh(self, module: Any) -> ColouredMesh:
        uv = evaluate(module, self.surface.uv)
        flat = np.column_stack([uv, np.zeros(len(uv))])
        return painted(flat, self.surface.faces, self.surface.vertices)

    def write_artefacts(
        self, folder: Path, result: Parameterization | ParameterizationAtlas
    ) -> None:
        if isinstance(result, ParameterizationAtlas):
            result.export(folder)
            return
        surface = self.surface
        inside = _into_square(result.uv)
        vertices = self.phi.in_original_units(surface.vertices)
        for ending in (".obj", ".glb"):
            export_surface(folder / f"parameterized{ending}", vertices, surface, inside)
        faces = surface.faces[~surface.filled]
        write_patterns(folder / "pattern", in_file_units(result), faces)
        energy = str(self.config.energy["_target_"]).rpartition(".")[2]
        name, before = list(self._before.items())[-1]
        what = {"domain": "domain Ω", "given": "given UV"}[name]
        before_after = {f"before: {what}": before, f"after: {energy}": result.uv}
        parameterization_picture(folder / "checkerboard.png", surface, before_after)


def _into_square(uv: np.ndarray) -> np.ndarray:
    """Coordinates (V, 2) moved and scaled as a whole into [-1, 1]², where textures lie."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    return (uv - 0.5 * (low + high)) * (2 / (high - low).max())
