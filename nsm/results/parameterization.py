"""Parameterizations: planar maps of neural surfaces."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

import nsm.energies
from nsm.domains import Domain
from nsm.domains.planar_mesh import signed_areas
from nsm.maps import Placed, PlanarMap
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.certificate import Correction, certificate, repaired
from nsm.results.evaluation import evaluate_double
from nsm.results.files import DAMAGE, damaged, read_pair, write_pair
from nsm.results.networks import network_of
from nsm.results.points import as_points
from nsm.surfaces.topology import face_areas

FORMAT = "nsm-parameterization"
STEM = "map"


@dataclass(frozen=True, eq=False)
class Parameterization:
    """A map h: Ω → R² of a neural surface φ, so that f∘φ = h flattens the surface.

    Attributes:
        phi: the surface.
        map: h, frozen.
        metrics: figures of :func:`nsm.results.planar_metrics` by method: ``nsm`` (with its
            certificate), ``domain`` (the surface's own layout) and the methods of libigl.
        config: the settings of the run that made it.
        correction: vertices that :meth:`repaired` moved, and where to.
    """

    phi: NeuralSurface
    map: nn.Module = field(repr=False)
    metrics: dict[str, dict[str, float]] = field(default_factory=dict, repr=False)
    config: dict[str, Any] = field(default_factory=dict, repr=False)
    correction: Correction = field(default_factory=Correction, repr=False)

    def __call__(self, uv: np.ndarray) -> np.ndarray:
        """Points (N, 2) of Ω to the plane (N, 2); linear on each triangle of the mesh.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        s = self.phi.surface
        uv = as_points(uv, 2, "points of the domain")
        return s.layout.locate(uv).take(self.uv, s.faces)

    def module(self) -> Placed:
        """h as a torch module from Ω to the plane, (N, 2) to (N, 2), with ``value_and_jacobian``.

        It is the network: smooth, and without :attr:`correction`, while the map of a call is linear
        on triangles. Values are in the units of :attr:`uv`. Its weights are a copy, frozen:
        ``module().requires_grad_(True)`` trains them, and leaves this map as it is.
        """
        return copy.deepcopy(Placed(self.map, 1 / self._size, torch.zeros(2)))

    @cached_property
    def uv(self) -> np.ndarray:
        """The new coordinates (V, 2) of the cut mesh's vertices, in its normalised units.

        An energy that does not see the scale, such as ``conformal``, leaves it to chance: the area
        is that of the surface then.
        """
        return self._laid * self._size

    @cached_property
    def _laid(self) -> np.ndarray:
        """The coordinates (V, 2) as h gives them, with the correction."""
        return self.correction.of(evaluate_double(self.map, self.phi.surface.uv))

    @cached_property
    def _size(self) -> float:
        """The factor from h to the new coordinates."""
        target = str(self.config.get("energy", {}).get("_target_", ""))
        known = getattr(nsm.energies, target.rpartition(".")[2], None)
        ours = target.startswith("nsm.energies.") and getattr(known, "scale_free", False)
        if not ours or self._target is not None:
            return 1.0
        s = self.phi.surface
        area = face_areas(s.vertices, s.faces).sum()
        return float(np.sqrt(area / np.abs(signed_areas(self._laid, s.faces)).sum()))

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """Whether the new coordinates are injective (see :func:`certificate`)."""
        return certificate(self._target, self._laid, self.phi.surface.faces)

    @property
    def _target(self) -> Domain | None:
        """The domain that h keeps to by construction, if any."""
        return None if isinstance(self.map, PlanarMap) else self.phi.surface.domain

    def repaired(self) -> Parameterization:
        """The map with its flipped triangles turned back, where possible."""
        surface = self.phi.surface
        nothing = np.zeros(len(surface.uv), dtype=bool)
        better = repaired(self._target, surface.uv, surface.faces, self._laid, nothing)
        return replace(self, correction=Correction.between(self._laid, better, self.correction))

    def save(self, folder: str | Path) -> None:
        """Write the surface and the map into a folder.

        Raises:
            OSError: the folder cannot be written.
        """
        save_surface(folder, self.phi)
        tensors = {**self.map.state_dict(), **self.correction.tensors()}
        metadata = {"map": self.map.config, "metrics": self.metrics, "config": self.config}
        write_pair(Path(folder) / STEM, FORMAT, tensors, metadata)


def load_parameterization(folder: str | Path, trust: Iterable[str] = ()) -> Parameterization:
    """Read what :meth:`Parameterization.save` wrote.

    Args, Raises:
        as for :func:`nsm.results.load_surface`.
    """
    stem = Path(folder) / STEM
    phi = load_surface(folder, trust)
    tensors, metadata = read_pair(stem, FORMAT)
    try:
        correction = Correction.taken(tensors, len(phi.surface.vertices))
        h = network_of(metadata["map"], tensors, trust)
        metrics, config = dict(metadata["metrics"]), dict(metadata["config"])
    except DAMAGE as error:
        raise damaged(stem, error) from error
    return Parameterization(phi, h, metrics, config, correction)


def in_file_units(flat: Parameterization) -> np.ndarray:
    """The new coordinates (V, 2) in the units of the mesh file."""
    return flat.uv / flat.phi.surface.scale
