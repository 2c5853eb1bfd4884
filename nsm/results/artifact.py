"""Neural surfaces: networks that are surfaces, with the meshes they were fitted to."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor, nn

from nsm.domains import Surface, from_stored, stored
from nsm.errors import NotRegistered
from nsm.maps import ANALYTIC, build_analytic, build_map
from nsm.results.files import BROKEN, misfit, read_pair, write_pair
from nsm.results.metrics import evaluate, evaluate_jacobian
from nsm.results.networks import network_of
from nsm.results.points import as_points, check_points
from nsm.surfaces.cutting import first_copies

FORMAT = "nsm-surface"
VERSION = 1
STEM = "surface"
_MOST_VERTICES = 200_000_000  # of a mesh file
_ARRAYS = ("vertices", "faces", "uv", "source_vertex", "cut_vertex", "seam_pairs", "center")


@dataclass(frozen=True, eq=False)
class NeuralSurface:
    """A network φ: Ω → R³ that is a surface, with the mesh that it was fitted to.

    Attributes:
        surface: the prepared mesh, in normalised units, as φ's values are.
        map: the network, frozen.
        metrics: figures of :func:`nsm.results.overfit_metrics`.
        config: the settings of the run that made it.
    """

    surface: Surface
    map: nn.Module = field(repr=False)
    metrics: dict[str, float] = field(default_factory=dict, repr=False)
    config: dict[str, Any] = field(default_factory=dict, repr=False)

    @overload
    def __call__(self, uv: np.ndarray) -> np.ndarray: ...
    @overload
    def __call__(self, uv: Tensor) -> Tensor: ...
    def __call__(self, uv: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """Points (N, 2) of Ω to points (N, 3) of the surface; numpy for numpy, torch for torch.

        Raises:
            NsmError: another shape; in arrays also NaN or infinity.
        """
        if isinstance(uv, Tensor):
            return self.map(self._fit(uv)).to(uv.dtype)
        return evaluate(self.map, as_points(uv, 2, "points of the domain"))

    @overload
    def jacobian(self, uv: np.ndarray) -> np.ndarray: ...
    @overload
    def jacobian(self, uv: Tensor) -> Tensor: ...
    def jacobian(self, uv: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """Jacobians (N, 3, 2) at points (N, 2) of Ω.

        Raises:
            NsmError: as :meth:`__call__`.
        """
        if isinstance(uv, Tensor):
            return self.map.value_and_jacobian(self._fit(uv))[1].to(uv.dtype)  # type: ignore[operator]
        return evaluate_jacobian(self.map, as_points(uv, 2, "points of the domain"))[1]

    def _fit(self, uv: Tensor) -> Tensor:
        """Points in the type of the network's weights; the caller's type is given back."""
        check_points(uv, "points of the domain")
        weight = next(self.map.parameters(), None)
        return uv if weight is None else uv.to(weight.dtype)

    def to_mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """φ at the mesh's vertices: (V, 3) normalised, faces (F, 3) and uv (V, 2)."""
        return self(self.surface.uv), self.surface.faces, self.surface.uv

    def in_original_units(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the surface in the units and place of the mesh file.

        Raises:
            NsmError: another shape, NaN or infinity.
        """
        points = as_points(points, 3, "points of the surface")
        return points / self.surface.scale + self.surface.center

    def save(self, folder: str | Path) -> None:
        """Write the two files of :func:`save_surface`."""
        save_surface(folder, self)


def save_surface(folder: str | Path, neural: NeuralSurface) -> None:
    """Write ``surface.safetensors`` and ``surface.json`` into a folder, whole or not at all.

    Raises:
        OSError: the folder cannot be written.
    """
    surface = neural.surface
    tensors = {f"map.{key}": value.contiguous() for key, value in neural.map.state_dict().items()}
    for name in _ARRAYS:
        array = np.ascontiguousarray(getattr(surface, name))
        tensors[f"surface.{name}"] = torch.from_numpy(array.copy())
    words = {
        "map": neural.map.config,
        "surface": {
            "name": surface.name,
            "domain": stored(surface.domain),
            "scale": surface.scale,
            "quality": surface.quality,
            "log": list(surface.log),
        },
        "metrics": neural.metrics,
        "config": neural.config,
    }
    write_pair(Path(folder) / STEM, FORMAT, VERSION, tensors, words)


def load_surface(folder: str | Path) -> NeuralSurface:
    """Read what :func:`save_surface` wrote, from its folder or from ``surface.safetensors``.

    Raises:
        NsmError: files that are missing, truncated, damaged, or of another version.
    """
    path = Path(folder)
    if path.name in (f"{STEM}.safetensors", f"{STEM}.json"):
        path = path.parent
    tensors, words = read_pair(path / STEM, FORMAT, VERSION)
    try:
        about = words["surface"]
        if "surface.cut_vertex" not in tensors:  # of a run that knew no merged vertices
            source = tensors["surface.source_vertex"].numpy()
            if not 0 <= source.max() < _MOST_VERTICES:  # rows are made for each of them
                raise ValueError("a vertex that no mesh file has")
            copies = first_copies(source, int(source.max()) + 1)
            tensors["surface.cut_vertex"] = torch.from_numpy(copies)
        arrays = {name: tensors.pop(f"surface.{name}").numpy() for name in _ARRAYS}
        surface = Surface(
            name=str(about["name"]),
            domain=from_stored(about["domain"]),
            scale=float(about["scale"]),
            quality=dict(about["quality"]),
            log=tuple(about["log"]),
            **arrays,
        )
        _check_shapes(surface)
        state = {k.removeprefix("map."): v for k, v in tensors.items()}
        network = _network(words["map"], state)
        metrics, config = dict(words["metrics"]), dict(words["config"])
    except BROKEN as error:
        raise misfit(path / STEM, error) from error
    network.eval().requires_grad_(False)
    return NeuralSurface(surface, network, metrics, config)


def _network(config: dict[str, Any], state: dict[str, Tensor]) -> nn.Module:
    """A network, or the closed form of an analytic surface, from its configuration and weights."""
    if "name" in config:
        if config["name"] not in ANALYTIC:
            raise NotRegistered("analytic surface", config["name"], "register_analytic")
        return build_analytic(config)
    if config.get("out_dim") != 3:
        raise ValueError("the network is no map to space")
    return network_of(build_map, config, state)


def _check_shapes(surface: Surface) -> None:
    """ValueError for arrays that are no surface: later work would fail far from the cause."""
    count = len(surface.vertices)
    expected = {"vertices": (count, 3), "uv": (count, 2), "source_vertex": (count,), "center": (3,)}
    for name, shape in expected.items():
        if getattr(surface, name).shape != shape:
            raise ValueError(f"{name} is not {shape}")
    for name in _ARRAYS:
        whole = name in ("faces", "source_vertex", "cut_vertex", "seam_pairs")
        if getattr(surface, name).dtype != (np.int64 if whole else np.float64):
            raise ValueError(f"{name} is not of its type")
    if len(surface.faces) == 0 or surface.source_vertex.min() < -1:
        raise ValueError("no faces, or a vertex of the file below -1")
    cut = surface.cut_vertex
    if cut.ndim != 1 or not surface.source_vertex.max() < len(cut):
        raise ValueError("a vertex that the mesh file does not have")
    if cut.min() < -1 or not 0 <= cut.max() < count:
        raise ValueError("a vertex of the file that became none of these")
    for name, columns in (("faces", 3), ("seam_pairs", 2)):
        index = getattr(surface, name)
        if index.ndim != 2 or index.shape[1] != columns:
            raise ValueError(f"{name} has not {columns} columns")
        if index.size and not 0 <= index.min() <= index.max() < count:
            raise ValueError(f"{name} names a vertex that is not there")
    if not 0 < surface.scale < float("inf"):
        raise ValueError("unknown scale")
