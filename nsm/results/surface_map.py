"""Maps between surfaces: where points go, and what they carry along."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.maps import Rotated, build_planar
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.certificate import Correction, certificate, repaired
from nsm.results.files import BROKEN, misfit, read_pair, write_pair
from nsm.results.metrics import evaluate
from nsm.results.networks import network_of
from nsm.results.points import as_points, as_values
from nsm.surfaces.location import Places, locate

FORMAT = "nsm-surface-map"
VERSION = 1
STEM = "pair"


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """A map f from one surface to another, f∘φ = ψ∘h.

    Points are in the units and place of the mesh files. f is linear on each triangle of the source
    in the target's domain, so that what is certified at the vertices holds for every point. Values
    are looked up on the meshes themselves; the networks φ and ψ only served to find h.

    Attributes:
        source, target: the neural surfaces φ and ψ.
        map: h, from the source's domain to the target's, frozen.
        landmarks: (L, 2) vertices of the two mesh files.
        metrics: figures of :func:`nsm.results.pair_metrics`.
        config: the settings of the run that made it.
        correction: vertices of the source that :meth:`repaired` moved off h, and where to.
    """

    source: NeuralSurface
    target: NeuralSurface
    map: nn.Module = field(repr=False)
    landmarks: np.ndarray = field(repr=False)
    metrics: dict[str, float] = field(default_factory=dict, repr=False)
    config: dict[str, Any] = field(default_factory=dict, repr=False)
    correction: Correction = field(default_factory=Correction, repr=False)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) anywhere on the source surface to points (N, 3) of the target.

        Points off the source start from the nearest point on it.

        Raises:
            NsmError: another shape, NaN or infinity.
        """
        s, t = self.source.surface, self.target.surface
        points = as_points(points, 3, "points on the source")
        with np.errstate(over="ignore"):  # what is far beyond all is answered as well
            normalised = (points - s.center) * s.scale
        uv = locate(normalised, s.vertices, s.faces).take(s.uv, s.faces)
        return self.target.in_original_units(_lifted(t, self.planar(uv)))

    def planar(self, uv: np.ndarray) -> np.ndarray:
        """Points (N, 2) of the source's domain to those of the target's, (N, 2).

        Raises:
            NsmError: another shape, NaN or infinity.
        """
        s = self.source.surface
        uv = as_points(uv, 2, "points of the domain")
        return locate(uv, s.uv, s.faces).take(self.image_uv, s.faces)

    @cached_property
    def image_uv(self) -> np.ndarray:
        """Where the source's vertices go: (V, 2) in the target's domain; h, but for corrections."""
        return self.correction.of(evaluate(self.map, self.source.surface.uv))

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """Whether the map to the target's domain is injective (see :func:`certificate`)."""
        return certificate(self.target.surface.domain, self.image_uv, self.source.surface.faces)

    def repaired(self) -> SurfaceMap:
        """The map with its flipped triangles turned back, and its boundary put in order, where
        that can be done; landmarks stay if that suffices. Figures are to be measured anew."""
        s = self.source.surface
        held = np.isin(s.source_vertex, s.kept(self.landmarks[:, 0].tolist()))
        better = repaired(s.domain, s.uv, s.faces, self.image_uv, held)
        result = replace(
            self, correction=Correction.between(self.image_uv, better, self.correction)
        )
        result.__dict__["image_uv"] = better  # inverses take seconds to find again
        return result

    @cached_property
    def image(self) -> np.ndarray:
        """Where the source's vertices (of the cut mesh) go: (V, 3) on the target, normalised."""
        return _lifted(self.target.surface, self.image_uv)

    @cached_property
    def _forth(self) -> Places:
        return locate(self.image_uv, self.target.surface.uv, self.target.surface.faces)

    @cached_property
    def _back(self) -> Places:
        return locate(self.target.surface.uv, self.image_uv, self.source.surface.faces)

    @cached_property
    def source_uv(self) -> np.ndarray:
        """h⁻¹ at the target's vertices (of the cut mesh): (V, 2) in the source's domain."""
        return self._back.take(self.source.surface.uv, self.source.surface.faces)

    def transfer(self, values: np.ndarray, *, back: bool = False) -> np.ndarray:
        """Carry values at the source's vertices over to the target's, or back.

        Args:
            values: (V, ...) a row for each vertex of the mesh file; whole numbers are taken for
                labels, which are picked instead of interpolated.
            back: from the target to the source.

        Returns:
            (W, ...) a row for each vertex of the other mesh file (see :func:`by_file_vertex`).

        Raises:
            NsmError: not a row for each vertex, or other values than finite numbers.
        """
        start, end = self.source.surface, self.target.surface
        places = self._back
        if back:
            start, end, places = end, start, self._forth
        inner = on_cut_mesh(start, as_values(values, "values to transfer"))
        if np.issubdtype(inner.dtype, np.integer) or inner.dtype == bool:
            best = places.weights.argmax(axis=1)
            moved = inner[start.faces[places.face, best]]
        else:
            moved = places.take(inner, start.faces)
        return by_file_vertex(end, moved)

    def morph(self, t: float) -> np.ndarray:
        """Vertices (V, 3) on the straight way from the source (t = 0) to the target (t = 1).

        Normalised units; the target is first turned and moved to lie best on the source.

        Raises:
            NsmError: t is not a finite number.
        """
        if not isinstance(t, Real) or not math.isfinite(t):
            raise NsmError(f"morph: {t!r} is not a number from 0 to 1")
        return (1 - t) * self.source.surface.vertices + t * self.aligned_image

    @cached_property
    def aligned_image(self) -> np.ndarray:
        """The image (V, 3), turned and moved (a rigid motion) to lie best on the source."""
        return self.aligned(self.image)

    def aligned(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) near the target, normalised, under that rigid motion (Kabsch).

        Raises:
            NsmError: another shape, NaN or infinity.
        """
        points = as_points(points, 3, "points near the target")
        image, reference = self.image, self.source.surface.vertices
        p, q = image.mean(axis=0), reference.mean(axis=0)
        u, _, vt = np.linalg.svd((image - p).T @ (reference - q))
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        return (points - p) @ (u @ flip @ vt) + q

    def save(self, folder: str | Path) -> None:
        """Write the map into a folder, and its surfaces into ``source`` and ``target`` there.

        Raises:
            OSError: the folder cannot be written.
        """
        place = Path(folder)
        save_surface(place / "source", self.source)
        save_surface(place / "target", self.target)
        tensors = {k: v.contiguous() for k, v in self.map.state_dict().items()}
        tensors.update(self.correction.tensors())
        words = {
            "map": self.map.inner.config,  # type: ignore[union-attr]
            "landmarks": self.landmarks.tolist(),
            "metrics": self.metrics,
            "config": self.config,
        }
        write_pair(place / STEM, FORMAT, VERSION, tensors, words)


def load_surface_map(folder: str | Path) -> SurfaceMap:
    """Read what :meth:`SurfaceMap.save` wrote.

    Raises:
        NsmError: files that are missing, truncated, damaged, or of another version.
    """
    place = Path(folder)
    tensors, words = read_pair(place / STEM, FORMAT, VERSION)
    source, target = load_surface(place / "source"), load_surface(place / "target")
    try:
        correction = Correction.taken(tensors, len(source.surface.vertices))
        h = network_of(rotated_planar, words["map"], tensors)
        landmarks = np.array(words["landmarks"], dtype=np.int64).reshape(-1, 2)
        metrics, config = dict(words["metrics"]), dict(words["config"])
    except BROKEN as error:
        raise misfit(place / STEM, error) from error
    h.eval().requires_grad_(False)
    return SurfaceMap(source, target, h, landmarks, metrics, config, correction)


def rotated_planar(config: dict[str, Any]) -> Rotated:
    """The planar map of a configuration, its input turned by a rotation that is still to come."""
    return Rotated(build_planar(config), torch.eye(2, device="cpu"))


def by_file_vertex(surface: Surface, values: np.ndarray) -> np.ndarray:
    """Values at the cut mesh's vertices (V, ...) as values at the mesh file's (W, ...).

    Of a seam vertex the first copy counts, of a merged one what it was merged with; a vertex of
    the file that is not on the surface has the value of the one with the nearest number that is.
    """
    row = surface.cut_vertex
    present = np.flatnonzero(row >= 0)
    nearest = present[np.searchsorted(present, np.arange(len(row))).clip(max=len(present) - 1)]
    return values[row[nearest]]


def on_cut_mesh(surface: Surface, values: np.ndarray) -> np.ndarray:
    """Values at the mesh file's vertices (W, ...) as values at the cut mesh's (V, ...).

    Vertices that were inserted between others get what these have: the mean, or a label.

    Raises:
        NsmError: not a row for each vertex of the file.
    """
    needed = len(surface.cut_vertex)
    if values.ndim == 0 or len(values) != needed:
        rows = 0 if values.ndim == 0 else len(values)
        raise NsmError(f"{surface.name} has {needed} vertices, but {rows} rows were given")
    result = values[np.maximum(surface.source_vertex, 0)]
    inserted = np.flatnonzero(surface.source_vertex < 0)
    whole = np.issubdtype(values.dtype, np.integer) or values.dtype == bool
    for vertex in inserted.tolist():
        around = np.unique(surface.faces[(surface.faces == vertex).any(axis=1)])
        around = around[surface.source_vertex[around] >= 0]
        result[vertex] = result[around[0]] if whole else result[around].mean(axis=0)
    return result


def _lifted(surface: Surface, uv: np.ndarray) -> np.ndarray:
    return locate(uv, surface.uv, surface.faces).take(surface.vertices, surface.faces)
