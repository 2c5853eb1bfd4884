"""Parameterisations: planar maps of neural surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nsm.maps import Planar, build_planar
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.files import misfit, read_pair, write_pair
from nsm.results.metrics import evaluate

FORMAT = "nsm-parameterization"
VERSION = 1
STEM = "map"


@dataclass(frozen=True, eq=False)
class Parameterization:
    """A map h: Ω → R² of a neural surface φ, so that f∘φ = h flattens the surface.

    Attributes:
        phi: the surface.
        map: h, frozen.
        metrics: figures of :func:`nsm.results.planar_metrics` by method: ``nsm``, the start
            (``domain``), and those of libigl on the same mesh.
        config: the settings of the run that made it.
    """

    phi: NeuralSurface
    map: Planar
    metrics: dict[str, dict[str, float]] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)

    def __call__(self, uv: np.ndarray) -> np.ndarray:
        """Points (N, 2) of Ω to the plane (N, 2)."""
        return evaluate(self.map, np.asarray(uv))

    @property
    def uv(self) -> np.ndarray:
        """The new coordinates (V, 2) of the cut mesh's vertices, in its normalised units."""
        return self(self.phi.surface.uv)

    def save(self, folder: str | Path) -> None:
        """Write the surface and the map into a folder.

        Raises:
            OSError: the folder cannot be written.
        """
        save_surface(folder, self.phi)
        tensors = {k: v.contiguous() for k, v in self.map.state_dict().items()}
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
        planar = build_planar(words["map"])
        planar.load_state_dict(tensors)
        metrics, config = dict(words["metrics"]), dict(words["config"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise misfit(stem, error) from error
    planar.eval().requires_grad_(False)
    return Parameterization(phi, planar, metrics, config)
