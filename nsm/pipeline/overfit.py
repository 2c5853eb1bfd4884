"""task=overfit: one surface becomes a network."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from nsm.data import SurfaceData
from nsm.domains import Surface
from nsm.pipeline.configured_surface import (
    configured_surface,
    keep_absolute,
    named_mesh,
    report_surface,
)
from nsm.pipeline.task import Given, Task, frozen
from nsm.results import (
    NeuralSurface,
    checkerboard_picture,
    error_picture,
    export_surface,
    metrics_table,
    overfit_metrics,
    reconstruction_image,
    warning_of_misfit,
)
from nsm.results.meshes import ColouredMesh, painted
from nsm.results.metrics import evaluate
from nsm.stages import done_in_turn
from nsm.tasks import Overfit
from nsm.tasks.least_squares import fit_linear_skip


class OverfitTask(Task):
    """A network φ: Ω → R³ is trained to be the surface.

    Attributes:
        start: a module of the same surface, seed and network that is not trained yet, whose fit is
            taken instead of another.
    """

    module, data, result, defaults = Overfit, SurfaceData, NeuralSurface, "overfit"
    table = staticmethod(metrics_table)
    closed_domains = True
    start: Overfit | None = None

    def inputs(self, given: Given) -> list[Any]:
        if given.surface is not None:
            return [given.surface]
        keep_absolute(self.config)
        return [named_mesh(self.config)]

    def prepare(self, given: Given) -> None:
        self.use(configured_surface(self.config, self.console, given.surface))
        report_surface(self.console, self.surface)

    def use(self, surface: Surface) -> None:
        """Take the prepared surface."""
        self.choose_domain(Given(surface=surface))
        self.surface = surface

    def build(self) -> Any:
        surface = self.surface
        settings = self.shared_settings()
        settings["encoding"] = self.domain.encoding(settings["encoding"], surface.lattice)
        module = self.module(**settings, diagonal=surface.bounding_box_diagonal)
        module.map = self.domain.symmetric(module.map)
        if self.start is not None:
            module.load_state_dict(self.start.state_dict())
        elif self.config.map.get("linear_skip") == "fitted":
            fit_linear_skip(module.map, surface, seed=self.config.seed)
        return module

    def make_result(self, module: Any) -> NeuralSurface:
        return NeuralSurface(self.surface, frozen(module.map), {}, self.settings)

    def measure(self, result: NeuralSurface) -> None:
        result.metrics.update(overfit_metrics(result.surface, result.map))

    def warnings(self, result: NeuralSurface) -> list[Text]:
        misfit = warning_of_misfit({result.surface.name: result.metrics})
        return [] if misfit is None else [misfit]

    def picture(self, module: Any) -> np.ndarray:
        return reconstruction_image(self.surface, module, size=384)

    def mesh(self, module: Any) -> ColouredMesh:
        surface = self.surface
        return painted(evaluate(module, surface.uv), surface.faces, surface.vertices)

    def write_artefacts(self, folder: Path, result: NeuralSurface) -> None:
        vertices = result(result.surface.uv)
        surface = result.surface

        def meshes() -> None:
            for ending in (".obj", ".glb"):
                export_surface(folder / f"reconstruction{ending}", vertices, surface, surface.uv)

        pictures = {"error.png": error_picture, "checkerboard.png": checkerboard_picture}
        drawn = {n: partial(d, folder / n, surface, result) for n, d in pictures.items()}
        done_in_turn("files", {"reconstruction": meshes, **drawn})
