"""Parameterizations: planar maps of neural surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nsm.domains import Domain
from nsm.maps import Planar, build_planar
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.certificate import Correction, certificate, repaired
from nsm.results.files import BROKEN, misfit, read_pair, write_pair
from nsm.results.metrics import evaluate
from nsm.results.networks import network_of
from nsm.results.points import as_points
from nsm.surfaces.location import locate

FORMAT = "nsm-parameterization"
VERSION = 1
STEM = "map"


@dataclass(frozen=True, eq=False)
class Parameterization:
    """A map h: Ω → R² of a neural surface φ, so that f∘φ = h flattens the surface.

    Attributes:
        phi: the surface.
        map: h, frozen.
        metrics: figures of :func:`nsm.results.planar_metrics` by method: ``nsm`` (with its
            certificate), the start (``domain``), and those of libigl on the same mesh.
        config: the settings of the run that made it.
        correction: vertices that :meth:`repaired` moved off h, and where to.
    """

    phi: NeuralSurface
    map: Planar = field(repr=False)
    metrics: dict[str, dict[str, float]] = field(default_factory=dict, repr=False)
    config: dict[str, Any] = field(default_factory=dict, repr=False)
    correction: Correction = field(default_factory=Correction, repr=False)

    def __call__(self, uv: np.ndarray) -> np.ndarray:
        """Points (N, 2) of Ω to the plane (N, 2); linear on each triangle of the mesh.

        Raises:
            NsmError: another shape, NaN or infinity.
        """
        s = self.phi.surface
        uv = as_points(uv, 2, "points of the domain")
        return locate(uv, s.uv, s.faces).take(self.uv, s.faces)

    @cached_property
    def uv(self) -> np.ndarray:
        """The new coordinates (V, 2) of the cut mesh's vertices, in its normalised units."""
        return self.correction.of(evaluate(self.map, self.phi.surface.uv))

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """Whether the new coordinates are injective (see :func:`certificate`)."""
        return certificate(self._onto, self.uv, self.phi.surface.faces)

    @property
    def _onto(self) -> Domain | None:
        return None if self.map.onto is None else self.phi.surface.domain

    def repaired(self) -> Parameterization:
        """The map with its flipped triangles turned back, where that can be done."""
        surface = self.phi.surface
        nothing = np.zeros(len(surface.uv), dtype=bool)
        better = repaired(self._onto, surface.uv, surface.faces, self.uv, nothing)
        return replace(self, correction=Correction.between(self.uv, better, self.correction))

    def save(self, folder: str | Path) -> None:
        """Write the surface and the map into a folder.

        Raises:
            OSError: the folder cannot be written.
        """
        save_surface(folder, self.phi)
        tensors = {k: v.contiguous() for k, v in self.map.state_dict().items()}
        tensors.update(self.correction.tensors())
        words = {"map": self.map.config, "metrics": self.metrics, "config": self.config}
        write_pair(Path(folder) / STEM, FORMAT, VERSION, tensors, words)


def load_parameterization(folder: str | Path) -> Parameterization:
    """Read what :meth:`Parameterization.save` wrote.

    Raises:
        NsmError: files that are missing, truncated, damaged, or of another version.
    """
    stem = Path(folder) / STEM
    phi = load_surface(folder)
    tensors, words = read_pair(stem, FORMAT, VERSION)
    try:
        correction = Correction.taken(tensors, len(phi.surface.vertices))
        planar = network_of(build_planar, words["map"], tensors)
        metrics, config = dict(words["metrics"]), dict(words["config"])
    except BROKEN as error:
        raise misfit(stem, error) from error
    planar.eval().requires_grad_(False)
    return Parameterization(phi, planar, metrics, config, correction)
