"""Collections of surfaces in correspondence: every pair's map, from one map of each."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from nsm.domains import BoundedDomain
from nsm.errors import NsmError
from nsm.maps import PlanarMap, TransitionMap
from nsm.maps.inverse import Inverse, inverted
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.certificate import Correction, combined
from nsm.results.files import DAMAGE, damaged, read_pair, write_pair
from nsm.results.metrics import evaluate
from nsm.results.networks import placed_map
from nsm.results.pair_metrics import pair_metrics
from nsm.results.surface_map import SurfaceMap
from nsm.stages import counted, part

FORMAT = "nsm-collection"
STEM = "collection"
_CYCLE_EVERY = 7  # every so many vertices, one is followed around a cycle
_CHUNK = 16_384  # vertices whose h_i⁻¹ is computed at once
_MOST_CYCLES = 60  # of k³
_MET = 1e-6  # in Ω


@dataclass(frozen=True, eq=False)
class SurfaceCollection:
    """k surfaces, each with a map h_i of a common domain: F_{i→j}∘φ_i∘h_i = φ_j∘h_j.

    Attributes:
        surfaces: the neural surfaces φ_i.
        maps: h_i, from the common domain to each surface's own, frozen.
        landmarks: (L, k) vertices of the mesh files; -1 where a surface lacks the landmark.
        metrics: figures of :func:`collection_metrics`.
        config: the settings of the run that made it.
        corrections: of the pairs (source, target) that :meth:`repaired` changed.
    """

    surfaces: list[NeuralSurface]
    maps: list[nn.Module] = field(repr=False)
    landmarks: np.ndarray = field(repr=False)
    metrics: dict[str, Any] = field(default_factory=dict, repr=False)
    config: dict[str, Any] = field(default_factory=dict, repr=False)
    corrections: dict[tuple[int, int], Correction] = field(default_factory=dict, repr=False)
    _made: dict[tuple[int, int], SurfaceMap] = field(default_factory=dict, repr=False)
    _inverses: dict[int, Inverse] = field(default_factory=dict, repr=False)
    _back: dict[int, np.ndarray] = field(default_factory=dict, repr=False)
    _marked: dict[int, Tensor] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.surfaces)

    @cached_property
    def names(self) -> list[str]:
        """Names of the surfaces; of equal ones the second is NAME-2, and so on."""
        names: list[str] = []
        for name in (phi.surface.name for phi in self.surfaces):
            candidates = [name, *(f"{name}-{k}" for k in range(2, len(self) + 2))]
            names.append(next(n for n in candidates if n not in names))
        return names

    @cached_property
    def pair_names(self) -> dict[tuple[int, int], str]:
        """Names of the ordered pairs, "SOURCE → TARGET"."""
        return {(i, j): f"{self.names[i]} → {self.names[j]}" for i, j in self._ordered}

    def pair(self, source: int | str, target: int | str) -> SurfaceMap:
        """The map F_{source→target} from any surface to any other, by number or by name.

        Raises:
            NsmError: ``out_of_range``: a number or name that no surface has.
        """
        ends = self._number(source), self._number(target)
        if ends not in self._made:
            self._made[ends] = self._pair(*ends)
        return self._made[ends]

    def _number(self, surface: int | str) -> int:
        if isinstance(surface, str) and surface in self.names:
            return self.names.index(surface)
        if isinstance(surface, str) or surface not in range(len(self)):
            listing = ", ".join(self.names)
            message = f"surface {surface!r} is not one of 0 to {len(self) - 1} ({listing})"
            raise NsmError(message, kind="out_of_range", key="surface")
        return int(surface)

    @property
    def statement(self) -> str:
        """What the certificate says of each map, if it holds."""
        return self.pair(0, 1).statement

    @property
    def certificate(self) -> dict[str, Any]:
        """Whether the maps of all ordered pairs are injective (see :func:`certificate`)."""
        return combined(
            self.pair(*ends).certificate for ends in counted("pairs checked", list(self._ordered))
        )

    def repaired(self) -> SurfaceCollection:
        """The collection with :meth:`SurfaceMap.repaired` maps."""
        made = {}
        for ends in self._ordered:
            with part(self.pair_names[ends]):
                made[ends] = self.pair(*ends).repaired()
        corrections = {ends: f.correction for ends, f in made.items() if len(f.correction.vertices)}
        return replace(self, corrections=corrections, _made=made)

    @property
    def _ordered(self) -> Iterator[tuple[int, int]]:
        return itertools.permutations(range(len(self)), 2)

    def _pair(self, source: int, target: int) -> SurfaceMap:
        first, second = (_double(self.maps[n]) for n in (source, target))
        s = self.surfaces[source].surface
        h = TransitionMap(first, second, self._nodes(source), self._project).eval()
        image = evaluate(h.second, self._preimages(source))
        return SurfaceMap(
            self.surfaces[source],
            self.surfaces[target],
            h,
            _common(self.landmarks[:, [source, target]]),
            {},
            self.config,
            self.corrections.get((source, target), Correction()),
            s.domain.copied(s.uv, s.seam_pairs, image),
        )

    def _preimages(self, source: int) -> np.ndarray:
        """h_i⁻¹ at the vertices of a surface: (V, 2) in the common domain."""
        if source not in self._back:  # it takes longest, and all maps of a source share it
            s, h = self.surfaces[source].surface, _double(self.maps[source])
            back = torch.as_tensor(self._pulled_back(source, s.uv))
            # where h_i folds beside a landmark, several points lead there: the common one is meant
            row, number = self._marked_rows(source)
            if len(row):
                wanted = torch.as_tensor(s.uv)[row]
                start = s.domain.lift(self._agreed[number], back[row])
                found = inverted(h, wanted, start, self._project)
                met = (h(found) - wanted).norm(dim=1) < _MET
                back[row[met.numpy()]] = found[met]
            self._back[source] = back.numpy()
        return self._back[source]

    def _marked_rows(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """The rows (R,) of a surface's uv that are landmarks, all copies, and which (R,) these
        are."""
        s, ids = self.surfaces[number].surface, self.landmarks[:, number]
        mine = np.flatnonzero(ids >= 0)
        row, which = np.nonzero(s.source_vertex[:, None] == s.kept(ids[mine].tolist()))
        return row, mine[which]

    @cached_property
    def _agreed(self) -> Tensor:
        """The landmarks in the common domain, (L, 2): of the places where the surfaces' maps have
        one, that nearest to all."""
        every = torch.stack([self._places(n) for n in range(len(self))])  # (k, L, 2)
        domain, whole = self.surfaces[0].surface.domain, every.flatten(0, 1)
        total = []
        for one in every:
            here = one.repeat(len(every), 1)
            apart = (domain.lift(whole, here) - here).norm(dim=1).view(len(every), -1)
            total.append(apart.nansum(dim=0).where(one.isfinite().all(dim=1), torch.inf))
        best = torch.stack(total).argmin(dim=0)
        return every[best, torch.arange(every.shape[1])]

    def _pulled_back(self, source: int, uv: np.ndarray) -> np.ndarray:
        """h_i⁻¹ at points (N, 2) of a surface's domain: (N, 2) in the common domain."""
        if source not in self._inverses:
            h, nodes = _double(self.maps[source]), self._nodes(source)
            self._inverses[source] = Inverse(h, nodes, self._project)
        parts = torch.as_tensor(uv).split(_CHUNK)
        return torch.cat([self._inverses[source](part) for part in parts]).numpy()

    @property
    def _project(self) -> Callable[[Tensor], Tensor] | None:
        """To the nearest points of the common domain, if maps keep to it."""
        domain, h = self.surfaces[0].surface.domain, self.maps[0]
        exact = isinstance(domain, BoundedDomain) and not isinstance(h.inner, PlanarMap)
        return domain.project if exact else None  # type: ignore[attr-defined]

    def _nodes(self, source: int) -> Tensor:
        """(M, 2) points of the common domain that Newton's method starts from.

        Those of the source's vertices: h_i is near the affine map that it starts from, so the
        surface's vertices, taken back, lie densely there. And where other maps have the landmarks:
        where h_i folds beside a landmark, several points lead there, and the common one is wanted.
        """
        s = self.surfaces[source].surface
        near: Tensor = _double(self.maps[source]).back(torch.as_tensor(s.uv))  # type: ignore[operator]
        row, number = self._marked_rows(source)
        others = [self._places(n)[number] for n in range(len(self)) if n != source]
        common = [x.isfinite().all(dim=1) for x in others]
        both = zip(others, common, strict=True)
        return torch.cat([near, *(s.domain.lift(x[there], near[row][there]) for x, there in both)])

    def _places(self, number: int) -> Tensor:
        """Where a surface's map has the landmarks in the common domain, (L, 2); NaN: nowhere."""
        if number not in self._marked:
            s, h = self.surfaces[number].surface, _double(self.maps[number])
            uv, ids = torch.as_tensor(s.uv), self.landmarks[:, number]
            targets = uv[s.cut_vertex[ids[ids >= 0]]]
            found = Inverse(h, h.back(uv), self._project)(targets)  # type: ignore[operator]
            places = found.new_full((len(ids), 2), torch.nan)
            places[torch.as_tensor(ids >= 0)] = found
            self._marked[number] = places
        return self._marked[number]

    def save(self, folder: str | Path) -> None:
        """Write the maps into a folder, and each surface into ``surface_0``, ... there.

        Raises:
            OSError: the folder cannot be written.
        """
        place = Path(folder)
        tensors = {}
        for k, (surface, h) in enumerate(zip(self.surfaces, self.maps, strict=True)):
            save_surface(place / f"surface_{k}", surface)
            tensors.update({f"{k}.{name}": v for name, v in h.state_dict().items()})
        for (i, j), correction in self.corrections.items():
            tensors.update(correction.tensors(f"{i}_to_{j}."))
        metadata = {
            "map": self.maps[0].inner.config,  # type: ignore[union-attr]
            "count": len(self),
            "landmarks": self.landmarks.tolist(),
            "metrics": self.metrics,
            "config": self.config,
        }
        write_pair(place / STEM, FORMAT, tensors, metadata)


def load_collection(folder: str | Path, trust: Iterable[str] = ()) -> SurfaceCollection:
    """Read what :meth:`SurfaceCollection.save` wrote.

    Args, Raises:
        as for :func:`nsm.results.load_surface`.
    """
    place = Path(folder)
    tensors, metadata = read_pair(place / STEM, FORMAT)
    try:
        count = int(metadata["count"])
        if not 2 < count <= len(tensors):
            raise ValueError(f"{count} surfaces")
        surfaces = [load_surface(place / f"surface_{k}", trust) for k in range(count)]
        corrections = {}
        for i, j in itertools.permutations(range(count), 2):
            found = Correction.taken(tensors, len(surfaces[i].surface.vertices), f"{i}_to_{j}.")
            if len(found.vertices):
                corrections[i, j] = found
        maps: list[nn.Module] = []
        for k in range(count):
            split = {name: name.partition(".") for name in tensors}
            own = {end: tensors[n] for n, (start, _, end) in split.items() if start == str(k)}
            maps.append(placed_map(metadata["map"], own, trust))
        landmarks = np.array(metadata["landmarks"], dtype=np.int64).reshape(-1, count)
        metrics, config = dict(metadata["metrics"]), dict(metadata["config"])
    except DAMAGE as error:
        raise damaged(place / STEM, error) from error
    return SurfaceCollection(surfaces, maps, landmarks, metrics, config, corrections)


def collection_metrics(
    collection: SurfaceCollection, points: np.ndarray, targets: Sequence[np.ndarray]
) -> dict[str, Any]:
    """The figures of every ordered pair, and the cycle error.

    Args:
        collection: the surfaces and their maps.
        points: (K, 2) landmarks in the common domain.
        targets: (K, 2) the same in each surface's own domain; NaN where it lacks the landmark.

    Returns:
        ``pairs``: name of the pair to the figures of :func:`nsm.results.pair_metrics` and its
        certificate; the certificate of all; cycle_error_mean_percent and _max_percent: the
        distance by which i→j→k→i misses a vertex, of the diagonal, over the cycles (if there are
        more than 60, over 60 evenly spread); and the same of the networks alone
        (cycle_error_networks_...). Those close wherever h_i⁻¹ is found; the maps, which are linear
        on the triangles of each surface, close approximately.
    """
    pairs = {}
    for i, j in counted("pairs measured", list(itertools.permutations(range(len(collection)), 2))):
        f = collection.pair(i, j)
        s, t = f.source.surface, f.target.surface
        both = np.isfinite(targets[i]).all(axis=1) & np.isfinite(targets[j]).all(axis=1)
        landed = f.planar(targets[i][both]) if both.any() else points[both]
        own = pair_metrics(s, t, f.image_uv, landed, targets[j][both])
        pairs[collection.pair_names[i, j]] = {**own, **f.certificate}
    figures: dict[str, Any] = {"pairs": pairs, **collection.certificate}
    cycles = list(itertools.permutations(range(len(collection)), 3))
    cycles = cycles[:: -(-len(cycles) // _MOST_CYCLES)]
    for name, followed in (("", _Followed), ("_networks", _FollowedByNetworks)):
        paths = followed(collection)
        errors = [paths.error(*cycle) for cycle in counted("cycles measured", cycles)]
        figures[f"cycle_error{name}_mean_percent"] = float(np.mean([e.mean() for e in errors]))
        figures[f"cycle_error{name}_max_percent"] = float(max(e.max() for e in errors))
    return figures


class _Followed:
    """Vertices of the surfaces, followed from one to the next."""

    def __init__(self, collection: SurfaceCollection) -> None:
        self.collection = collection
        self.after = cache(self._after)  # cycles begin alike

    def error(self, i: int, j: int, k: int) -> np.ndarray:
        """Distances (V,) of vertices of i from their images by i→j→k→i, in percent of the
        diagonal."""
        surface = self.collection.surfaces[i].surface
        return self._off(self.after(i, j, k, i), i) * 100 / surface.bounding_box_diagonal

    def _after(self, *path: int) -> np.ndarray:
        """Where vertices of the first surface of a path are on the last one, (V, 3)."""
        *before, last = path
        if not before:
            surface = self.collection.surfaces[last]
            return surface.in_original_units(surface.surface.vertices[::_CYCLE_EVERY])
        return self.collection.pair(before[-1], last)(self.after(*before))

    def _off(self, points: np.ndarray, i: int) -> np.ndarray:
        """How far points (V, 3) of a surface are from its vertices, in normalised units."""
        scale = self.collection.surfaces[i].surface.scale
        return np.asarray(np.linalg.norm(points - self.after(i), axis=1) * scale)


class _FollowedByNetworks(_Followed):
    """The same by the networks alone, from domain to domain."""

    def __init__(self, collection: SurfaceCollection) -> None:
        super().__init__(collection)
        self.common = cache(self._common)

    def _after(self, *path: int) -> np.ndarray:
        """As points (V, 2) of the last surface's domain."""
        *before, last = path
        surface = self.collection.surfaces[last].surface
        if not before:
            return surface.uv[::_CYCLE_EVERY]
        image = evaluate(_double(self.collection.maps[last]), self.common(*before))
        return surface.domain.canonical(image)

    def _common(self, *path: int) -> np.ndarray:
        """As points (V, 2) of the common domain."""
        if len(path) == 1:
            return self.collection._preimages(path[0])[::_CYCLE_EVERY]
        return self.collection._pulled_back(path[-1], self.after(*path))

    def _off(self, points: np.ndarray, i: int) -> np.ndarray:
        surface = self.collection.surfaces[i].surface
        return np.asarray(
            np.linalg.norm(surface.at(points) - surface.vertices[::_CYCLE_EVERY], axis=1)
        )


def _common(landmarks: np.ndarray) -> np.ndarray:
    """The landmarks (L, 2) that both surfaces have."""
    return np.asarray(landmarks[(landmarks >= 0).all(axis=1)])


def _double(h: nn.Module) -> nn.Module:
    """A copy in float64, for the last digits of Newton's method."""
    return copy.deepcopy(h).double()
