"""Neural surfaces: networks that describe surfaces, with the meshes they were fitted to."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor, nn

from nsm.domains import Surface, from_stored, stored
from nsm.domains.surface import ARRAYS, OPTIONAL
from nsm.energies import spectrum
from nsm.errors import NsmError
from nsm.maps import Placed
from nsm.results.devices import as_device
from nsm.results.files import DAMAGE, damaged, read_pair, write_pair
from nsm.results.metrics import evaluate, evaluate_jacobian
from nsm.results.networks import network_of
from nsm.results.points import as_points, check_points
from nsm.results.vertex_values import by_file_vertex
from nsm.surfaces.holes import FIRST

FORMAT = "nsm-surface"
STEM = "surface"
_POINTS = "points of the domain"
_RAW = ("raw.vertices", "raw.faces")


@dataclass(frozen=True, eq=False)
class NeuralSurface:
    """A network φ: Ω → R³ that describes a surface, with the mesh that it was fitted to.

    Called with points of Ω it gives points in the units and place of the mesh file. ``phi.map`` is
    the network alone, whose values are normalised: centred, and scaled to the area of Ω.

    Attributes:
        surface: the prepared mesh, in normalised units.
        map: the network, normalised and frozen.
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
        """Points (N, 2) of Ω to points (N, 3) of the surface, in the units of the mesh file.

        numpy for numpy; for a tensor a tensor of its type, with a gradient for uv, and for the
        network's weights after ``phi.map.requires_grad_(True)``.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type``; for arrays also ``not_finite``.
        """
        if isinstance(uv, Tensor):
            check_points(uv, _POINTS)
            return self._placed(uv)
        s = self.surface
        return evaluate(self.map, as_points(uv, 2, _POINTS)) / s.scale + s.center

    @overload
    def jacobian(self, uv: np.ndarray) -> np.ndarray: ...
    @overload
    def jacobian(self, uv: Tensor) -> Tensor: ...
    def jacobian(self, uv: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """Jacobians (N, 3, 2) at points (N, 2) of Ω: units of the mesh file per unit of Ω.

        Raises:
            NsmError: as :meth:`__call__`.
        """
        return self.value_and_jacobian(uv)[1]

    @overload
    def value_and_jacobian(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...
    @overload
    def value_and_jacobian(self, uv: Tensor) -> tuple[Tensor, Tensor]: ...
    def value_and_jacobian(
        self, uv: np.ndarray | Tensor
    ) -> tuple[np.ndarray, np.ndarray] | tuple[Tensor, Tensor]:
        """What :meth:`__call__` and :meth:`jacobian` give, (N, 3) and (N, 3, 2), in one pass.

        Raises:
            NsmError: as :meth:`__call__`.
        """
        if isinstance(uv, Tensor):
            check_points(uv, _POINTS)
            return self._placed.value_and_jacobian(uv)
        s = self.surface
        value, jacobian = evaluate_jacobian(self.map, as_points(uv, 2, _POINTS))
        return value / s.scale + s.center, jacobian / s.scale

    def module(self) -> Placed:
        """φ as a torch module from Ω to the units of the mesh file, with ``value_and_jacobian``.

        Its weights are a copy, frozen: ``module().requires_grad_(True)`` trains them, and leaves
        this surface as it is.
        """
        return copy.deepcopy(self._placed)

    def to(self, device: torch.device | str) -> NeuralSurface:
        """The same surface with its network on a device.

        Raises:
            NsmError: as :func:`nsm.results.devices.as_device`.
        """
        return replace(self, map=copy.deepcopy(self.map).to(as_device(device)))

    @property
    def _placed(self) -> Placed:
        s = self.surface
        return Placed(self.map, s.scale, torch.as_tensor(s.center))

    def file_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """The mesh as it was given: vertices (W, 3) and faces (G, 3), in its order and units.

        A surface that an older version stored has lost it: vertices and faces that the preparation
        removed are then not there, or not in their place, and faces are in another order.
        """
        s = self.surface
        if s.raw is not None:
            return s.raw
        return by_file_vertex(s, self.in_original_units(s.vertices)), s.file_faces()[0]

    def spectrum(self, count: int = 10) -> tuple[np.ndarray, np.ndarray]:
        """The smallest eigenvalues of the Laplace–Beltrami operator, and their functions.

        See :func:`nsm.energies.spectrum`: functions are linear on the mesh's triangles of Ω, the
        metric is that of φ, and a seam is joined.

        Args:
            count: how many, the constant function's λ = 0 among them.

        Returns:
            λ (count,), ascending, per square unit of the mesh file, and functions (W, count) at the
            vertices of the mesh file.

        Raises:
            NsmError: ``out_of_range``: count is not from 1 to the number of vertices less one.
        """
        s = self.surface
        vertex = s.source_vertex
        # points inserted between others have no copies; those in filled holes may have
        joined = np.where(vertex == -1, len(s.cut_vertex) + np.arange(len(vertex)), vertex)
        most = len(np.unique(joined)) - 1
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= most:
            message = f"count: {count!r} is not a whole number from 1 to {most}"
            raise NsmError(message, kind="out_of_range", key="count")
        values, functions = spectrum(self.module().cpu(), s.uv, s.faces, count, joined=joined)
        return values, by_file_vertex(s, functions)

    def to_mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """φ at the mesh's vertices: (V, 3) in the units of its file, faces (F, 3) and uv (V, 2).

        On a closed domain these are the vertices and faces of the mesh file, without copies, so
        that the mesh is closed; uv is then one lift of each vertex. Elsewhere they are those of the
        cut mesh, ``surface``. Filled holes are left out.
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
    if surface.raw is not None:
        for name, array in zip(_RAW, surface.raw, strict=True):
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
        raw = [tensors.pop(f"surface.{n}").numpy() for n in _RAW if f"surface.{n}" in tensors]
        surface = Surface(
            name=str(about["name"]),
            domain=from_stored(about["domain"], trust),
            scale=float(about["scale"]),
            quality=dict(about["quality"]),
            log=tuple(about["log"]),
            raw=(raw[0], raw[1]) if len(raw) == 2 else None,
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
    caps = surface.caps
    if caps is not None and (caps.shape != (len(surface.faces),) or caps.dtype != np.bool_):
        raise ValueError("caps is no mask of the faces")
    if caps is not None and caps.all():
        raise ValueError("caps are all that there is")
    for name, array in surface.arrays().items():
        if name == "caps":
            continue
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
    if surface.given_uv is not None and surface.given_uv.shape != surface.uv.shape:
        raise ValueError("given_uv is not of these vertices")
    if (surface.lattice is None) != surface.domain.has_boundary:
        raise ValueError("lattice is missing, or there without a closed domain")
    if surface.lattice is not None and surface.lattice.shape != (2, 2):
        raise ValueError("lattice is not (2, 2)")
    if surface.raw is not None:
        points, triangles = surface.raw
        if points.shape != (len(cut), 3) or points.dtype != np.float64:
            raise ValueError("the mesh file's vertices do not fit")
        if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype != np.int64:
            raise ValueError("the mesh file's faces are no triangles")
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(points):
            raise ValueError("the mesh file's faces name a vertex that is not there")
    if not 0 < surface.scale < float("inf"):
        raise ValueError("unknown scale")
