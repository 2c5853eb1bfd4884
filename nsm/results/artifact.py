"""Neural surfaces: networks that describe surfaces, with the meshes they were fitted to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor, nn

from nsm.domains import Surface, from_stored, stored
from nsm.domains.surface import ARRAYS, OPTIONAL
from nsm.results.files import DAMAGE, damaged, read_pair, write_pair
from nsm.results.metrics import evaluate, evaluate_jacobian
from nsm.results.networks import network_of
from nsm.results.points import as_points, check_points
from nsm.surfaces.holes import FIRST

FORMAT = "nsm-surface"
STEM = "surface"


@dataclass(frozen=True, eq=False)
class NeuralSurface:
    """A network φ: Ω → R³ that describes a surface, with the mesh that it was fitted to.

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
            NsmError: ``wrong_shape``, ``wrong_type``; for arrays also ``not_finite``.
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
        """Points (N, 2) in the type of the network's weights."""
        check_points(uv, "points of the domain")
        weight = next(self.map.parameters(), None)
        return uv if weight is None else uv.to(weight.dtype)

    def to_mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """φ at the mesh's vertices: (V, 3) normalised, faces (F, 3) and uv (V, 2).

        On a closed domain these are the vertices and faces of the mesh file, without copies, so
        that the mesh is closed; uv is then one lift of each vertex. Filled holes are left out.
        """
        uv, (shown, faces) = self.surface.uv, self.surface.shown()
        return self(uv[shown]), faces, uv[shown]

    def in_original_units(self, points: np.ndarray) -> np.ndarray:
        """Normalised points (N, 3) in the units and place of the mesh file.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        points = as_points(points, 3, "points of the surface")
        return points / self.surface.scale + self.surface.center

    def save(self, folder: str | Path) -> None:
        """Write the two files of :func:`save_surface`."""
        save_surface(folder, self)


def save_surface(folder: str | Path, neural: NeuralSurface) -> None:
    """Write ``surface.safetensors`` and ``surface.json`` into a folder, both or neither.

    Raises:
        OSError: the folder cannot be written.
    """
    surface = neural.surface
    tensors = {f"map.{key}": value for key, value in neural.map.state_dict().items()}
    for name, array in surface.arrays().items():
        tensors[f"surface.{name}"] = torch.from_numpy(np.ascontiguousarray(array).copy())
    metadata = {
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
    write_pair(Path(folder) / STEM, FORMAT, tensors, metadata)


def is_stored_surface(name: str) -> bool:
    """Whether a path is that of what :func:`save_surface` wrote: the folder or the weights."""
    file = f"{STEM}.safetensors"
    return (Path(name) / f"{STEM}.json").exists() or name.endswith(file)


def load_surface(folder: str | Path, trust: Iterable[str] = ()) -> NeuralSurface:
    """Read what :func:`save_surface` wrote.

    Args:
        folder: where it was written, or either of the two files.
        trust: modules whose classes the files may name; loading runs their code.

    Raises:
        NsmError: ``missing_file``, ``unreadable_file``, ``wrong_format``, ``wrong_version``,
            ``damaged_file``, ``not_trusted``, ``not_registered``.
    """
    path = Path(folder)
    if path.name in (f"{STEM}.safetensors", f"{STEM}.json"):
        path = path.parent
    tensors, metadata = read_pair(path / STEM, FORMAT)
    try:
        about = metadata["surface"]
        arrays: dict[str, Any] = {name: tensors.pop(f"surface.{name}").numpy() for name in ARRAYS}
        for name in OPTIONAL:
            if f"surface.{name}" in tensors:
                arrays[name] = tensors.pop(f"surface.{name}").numpy()
        surface = Surface(
            name=str(about["name"]),
            domain=from_stored(about["domain"], trust),
            scale=float(about["scale"]),
            quality=dict(about["quality"]),
            log=tuple(about["log"]),
            **arrays,
        )
        _check_arrays(surface)
        if metadata["map"].get("out_dim", 3) != 3:
            raise ValueError("the network is no map to space")
        state = {key.removeprefix("map."): value for key, value in tensors.items()}
        network = network_of(metadata["map"], state, trust)
        metrics, config = dict(metadata["metrics"]), dict(metadata["config"])
    except DAMAGE as error:
        raise damaged(path / STEM, error) from error
    return NeuralSurface(surface, network, metrics, config)


def _check_arrays(surface: Surface) -> None:
    """ValueError for arrays that are no surface: later work would fail far from the cause."""
    count = len(surface.vertices)
    expected = {"vertices": (count, 3), "uv": (count, 2), "source_vertex": (count,), "center": (3,)}
    for name, shape in expected.items():
        if getattr(surface, name).shape != shape:
            raise ValueError(f"{name} is not {shape}")
    for name, array in surface.arrays().items():
        whole = name in ("faces", "source_vertex", "cut_vertex", "seam_pairs", "ends")
        if array.dtype != (np.int64 if whole else np.float64):
            raise ValueError(f"{name} has another type")
    if len(surface.faces) == 0 or surface.source_vertex.min() < FIRST - count:
        raise ValueError("no faces, or more filled holes than vertices")
    cut = surface.cut_vertex
    if cut.ndim != 1 or not surface.source_vertex.max() < len(cut):
        raise ValueError("source_vertex names a vertex that the mesh file does not have")
    if cut.min() < -1 or not 0 <= cut.max() < count:
        raise ValueError("cut_vertex names a vertex that is not there")
    for name, columns in (("faces", 3), ("seam_pairs", 2)):
        index = getattr(surface, name)
        if index.ndim != 2 or index.shape[1] != columns:
            raise ValueError(f"{name} has not {columns} columns")
        if index.size and not 0 <= index.min() <= index.max() < count:
            raise ValueError(f"{name} names a vertex that is not there")
    if (surface.lattice is None) != surface.domain.has_boundary:
        raise ValueError("lattice is missing, or there without a closed domain")
    if surface.lattice is not None and surface.lattice.shape != (2, 2):
        raise ValueError("lattice is not (2, 2)")
    if not 0 < surface.scale < float("inf"):
        raise ValueError("unknown scale")
