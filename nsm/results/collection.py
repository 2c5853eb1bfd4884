"""Collections of surfaces in correspondence: every pair's map, from one map of each."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from nsm.errors import NsmError
from nsm.maps import TransitionMap
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.certificate import Correction, combined
from nsm.results.files import BROKEN, misfit, read_pair, write_pair
from nsm.results.metrics import evaluate
from nsm.results.networks import network_of
from nsm.results.pair_metrics import pair_metrics
from nsm.results.surface_map import SurfaceMap, rotated_planar
from nsm.surfaces.location import locate

FORMAT = "nsm-collection"
VERSION = 1
STEM = "collection"
_CYCLE_EVERY = 7  # vertices, of which one is taken
_CHUNK = 16_384  # vertices whose way back is found at once
_MOST_CYCLES = 60  # there are k³ of them


@dataclass(frozen=True, eq=False)
class SurfaceCollection:
    """k surfaces, each with a map h_i of a common domain: F_{i→j}∘φ_i∘h_i = φ_j∘h_j.

    Attributes:
        surfaces: the neural surfaces φ_i.
        maps: h_i, from the common domain to each surface's own, frozen.
        landmarks: (L, k) vertices of the mesh files.
        metrics: figures of :func:`collection_metrics`.
        config: the settings of the run that made it.
        corrections: of the pairs (source, target) that :meth:`repaired` had to mend.
    """

    surfaces: list[NeuralSurface]
    maps: list[nn.Module] = field(repr=False)
    landmarks: np.ndarray = field(repr=False)
    metrics: dict[str, Any] = field(default_factory=dict, repr=False)
    config: dict[str, Any] = field(default_factory=dict, repr=False)
    corrections: dict[tuple[int, int], Correction] = field(default_factory=dict, repr=False)
    _made: dict[tuple[int, int], SurfaceMap] = field(default_factory=dict, repr=False)
    _back: dict[int, np.ndarray] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.surfaces)

    def pair(self, source: int, target: int) -> SurfaceMap:
        """The map F_{source→target}: points, transfer and morph from any surface to any other.

        Raises:
            NsmError: a number that no surface has.
        """
        for number in (source, target):
            if number not in range(len(self)):
                raise NsmError(f"surface {number!r} is not one of 0 to {len(self) - 1}")
        if (source, target) not in self._made:
            self._made[source, target] = self._pair(source, target)
        return self._made[source, target]

    @property
    def certificate(self) -> dict[str, Any]:
        """Whether the maps of all ordered pairs are injective (see :func:`certificate`)."""
        return combined(self.pair(*ends).certificate for ends in self._ordered)

    def repaired(self) -> SurfaceCollection:
        """The collection with :meth:`SurfaceMap.repaired` maps."""
        made = {ends: self.pair(*ends).repaired() for ends in self._ordered}
        corrections = {ends: f.correction for ends, f in made.items() if len(f.correction.vertices)}
        return replace(self, corrections=corrections, _made=made)

    @property
    def _ordered(self) -> Iterator[tuple[int, int]]:
        return itertools.permutations(range(len(self)), 2)

    def _pair(self, source: int, target: int) -> SurfaceMap:
        # h_i is near the rotation that it started from, so the surface's vertices, turned back,
        # lie densely in the common domain
        first = self.maps[source]
        turn = first.rotation.double().numpy()  # type: ignore[union-attr, operator]
        nodes = torch.as_tensor(self.surfaces[source].surface.uv @ turn)
        onto = first.inner.config.get("onto")  # type: ignore[union-attr, operator]
        h = TransitionMap(_double(first), _double(self.maps[target]), nodes, onto)
        ids = self.landmarks[:, [source, target]]
        ends = self.surfaces[source], self.surfaces[target]
        correction = self.corrections.get((source, target), Correction())
        result = SurfaceMap(*ends, h.eval(), ids, {}, self.config, correction)
        if source not in self._back:  # of a surface's k - 1 maps the part that takes longest
            uv = torch.as_tensor(self.surfaces[source].surface.uv)
            self._back[source] = torch.cat([h.back(part) for part in uv.split(_CHUNK)]).numpy()
        result.__dict__["image_uv"] = correction.of(evaluate(h.second, self._back[source]))
        return result

    def save(self, folder: str | Path) -> None:
        """Write the maps into a folder, and each surface into ``surface_0``, ... there.

        Raises:
            OSError: the folder cannot be written.
        """
        place = Path(folder)
        tensors = {}
        for k, (surface, h) in enumerate(zip(self.surfaces, self.maps, strict=True)):
            save_surface(place / f"surface_{k}", surface)
            tensors.update({f"{k}.{n}": v.contiguous() for n, v in h.state_dict().items()})
        for (i, j), correction in self.corrections.items():
            tensors.update(correction.tensors(f"{i}_to_{j}."))
        words = {
            "map": self.maps[0].inner.config,  # type: ignore[union-attr]
            "count": len(self),
            "landmarks": self.landmarks.tolist(),
            "metrics": self.metrics,
            "config": self.config,
        }
        write_pair(place / STEM, FORMAT, VERSION, tensors, words)


def load_collection(folder: str | Path) -> SurfaceCollection:
    """Read what :meth:`SurfaceCollection.save` wrote.

    Raises:
        NsmError: files that are missing, truncated, damaged, or of another version.
    """
    place = Path(folder)
    tensors, words = read_pair(place / STEM, FORMAT, VERSION)
    try:
        count = int(words["count"])
        if not 2 < count <= len(tensors):
            raise ValueError(f"{count} surfaces")
    except BROKEN as error:
        raise misfit(place / STEM, error) from error
    surfaces = [load_surface(place / f"surface_{k}") for k in range(count)]
    try:
        corrections = {}
        for i, j in itertools.permutations(range(count), 2):
            found = Correction.taken(tensors, len(surfaces[i].surface.vertices), f"{i}_to_{j}.")
            if len(found.vertices):
                corrections[i, j] = found
        maps: list[nn.Module] = []
        for k in range(count):
            own = {
                n.split(".", 1)[1]: v for n, v in tensors.items() if n.split(".", 1)[0] == str(k)
            }
            h = network_of(rotated_planar, words["map"], own)
            maps.append(h.eval().requires_grad_(False))
        landmarks = np.array(words["landmarks"], dtype=np.int64).reshape(-1, count)
        metrics, config = dict(words["metrics"]), dict(words["config"])
    except BROKEN as error:
        raise misfit(place / STEM, error) from error
    return SurfaceCollection(surfaces, maps, landmarks, metrics, config, corrections)


def collection_metrics(
    collection: SurfaceCollection, points: np.ndarray, targets: Sequence[np.ndarray]
) -> dict[str, Any]:
    """Every ordered pair's figures, and the cycle error.

    Args:
        collection: the surfaces and their maps.
        points: (K, 2) landmarks in the common domain.
        targets: (K, 2) the same in each surface's own domain.

    Returns:
        ``pairs``: "i → j" to the figures of :func:`nsm.results.pair_metrics` and the map's
        certificate; the certificate of all; cycle_error_mean and _max_percent: how far i→j→k→i
        misses a vertex, of the diagonal, over the cycles (of more than 60, 60 evenly spread); the
        same of the networks
        (cycle_error_networks_...), which close but for where h_i⁻¹ is not found, while the maps
        are linear on the triangles of each surface.
    """
    pairs = {}
    for i, j in itertools.permutations(range(len(collection)), 2):
        f = collection.pair(i, j)
        s, t = f.source.surface, f.target.surface
        landed = f.planar(targets[i]) if len(points) else points
        own = pair_metrics(s, t, f.image_uv, landed, targets[j])
        pairs[f"{s.name} → {t.name}"] = {**own, **f.certificate}
    figures: dict[str, Any] = {"pairs": pairs, **collection.certificate}
    cycles = list(itertools.permutations(range(len(collection)), 3))
    cycles = cycles[:: -(-len(cycles) // _MOST_CYCLES)]
    for name, error in (("", _cycle_error), ("_networks", _networks_cycle_error)):
        errors = [error(collection, *cycle) for cycle in cycles]
        figures[f"cycle_error{name}_mean_percent"] = float(np.mean([e.mean() for e in errors]))
        figures[f"cycle_error{name}_max_percent"] = float(max(e.max() for e in errors))
    return figures


def _cycle_error(collection: SurfaceCollection, i: int, j: int, k: int) -> np.ndarray:
    """Distance (V,) between a vertex of i and its image by i→j→k→i, in percent of the diagonal."""
    surface = collection.surfaces[i]
    start = surface.in_original_units(surface.surface.vertices[::_CYCLE_EVERY])
    points = start
    for a, b in ((i, j), (j, k), (k, i)):
        points = collection.pair(a, b)(points)
    diagonal = surface.surface.bounding_box_diagonal / surface.surface.scale
    return 100 * np.linalg.norm(points - start, axis=1) / diagonal


def _networks_cycle_error(collection: SurfaceCollection, i: int, j: int, k: int) -> np.ndarray:
    """The same (V,) by the networks alone, from domain to domain."""
    surface = collection.surfaces[i].surface
    uv = surface.uv[::_CYCLE_EVERY]
    for a, b in ((i, j), (j, k), (k, i)):
        uv = evaluate(collection.pair(a, b).map, uv)
    end = locate(uv, surface.uv, surface.faces).take(surface.vertices, surface.faces)
    off = np.linalg.norm(end - surface.vertices[::_CYCLE_EVERY], axis=1)
    return 100 * off / surface.bounding_box_diagonal


def _double(h: nn.Module) -> nn.Module:
    """A copy in float64, for Newton's last digits."""
    import copy

    return copy.deepcopy(h).double()
