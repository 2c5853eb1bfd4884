"""Maps between surfaces, one after the other."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from nsm.errors import NsmError
from nsm.results.artifact import NeuralSurface
from nsm.results.file_faces import FileFaces, same_mesh
from nsm.results.files import atomic_write
from nsm.results.points import as_points, as_values
from nsm.results.pointwise import MapSequence
from nsm.results.vertex_values import check_rows
from nsm.surfaces.location import Places

if TYPE_CHECKING:
    from nsm.results.surface_map import SurfaceMap


@dataclass(frozen=True, eq=False)
class ComposedMap:
    """x ↦ g(f(x)) of maps between surfaces, as ``g @ f`` makes it.

    Between two maps points are in the units of the mesh file, so that the surfaces may be cut or
    laid out differently.

    Attributes:
        maps: in the order in which they are applied; each starts from the mesh that the one before
            ends on.
    """

    maps: tuple[SurfaceMap, ...]

    @property
    def source(self) -> NeuralSurface:
        """The surface that the first map starts from."""
        return self.maps[0].source

    @property
    def target(self) -> NeuralSurface:
        """The surface that the last map ends on."""
        return self.maps[-1].target

    @overload
    def __call__(self, points: np.ndarray) -> np.ndarray: ...
    @overload
    def __call__(self, points: Tensor) -> Tensor: ...
    def __call__(self, points: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """As :meth:`SurfaceMap.__call__`."""
        for f in self.maps:
            points = f(points)
        return points

    @overload
    def inverse(self, points: np.ndarray) -> np.ndarray: ...
    @overload
    def inverse(self, points: Tensor) -> Tensor: ...
    def inverse(self, points: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """As :meth:`SurfaceMap.inverse`."""
        for f in reversed(self.maps):
            points = f.inverse(points)
        return points

    @overload
    def value_and_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...
    @overload
    def value_and_jacobian(self, points: Tensor) -> tuple[Tensor, Tensor]: ...
    def value_and_jacobian(
        self, points: np.ndarray | Tensor
    ) -> tuple[np.ndarray, np.ndarray] | tuple[Tensor, Tensor]:
        """As :meth:`SurfaceMap.value_and_jacobian`, by the chain rule."""
        if not isinstance(points, Tensor):
            given = torch.from_numpy(as_points(points, 3, "points on the source"))
            image, slope = self.value_and_jacobian(given)
            return image.numpy(), slope.numpy()
        value, jacobian = self.maps[0].value_and_jacobian(points)
        for f in self.maps[1:]:
            value, own = f.value_and_jacobian(value)
            jacobian = own @ jacobian
        return value, jacobian

    def __matmul__(self, other: SurfaceMap | ComposedMap) -> ComposedMap:
        """As :meth:`SurfaceMap.__matmul__`."""
        return composed(self, other)

    def module(self) -> MapSequence:
        """The maps' modules (:meth:`SurfaceMap.module`), one after the other."""
        return MapSequence(*(f.module() for f in self.maps))

    def to(self, device: torch.device | str) -> ComposedMap:
        """As :meth:`SurfaceMap.to`."""
        return ComposedMap(tuple(f.to(device) for f in self.maps))

    def correspondences(self, *, back: bool = False) -> Places:
        """As :meth:`SurfaceMap.correspondences`."""
        ordered = self.maps[::-1] if back else self.maps
        places = ordered[0].correspondences(back=back)
        for f in ordered[1:]:
            start, end = (f.target, f.source) if back else (f.source, f.target)
            here = FileFaces(start.surface, *start.file_mesh(), start.surface.name)
            there = FileFaces(end.surface, *end.file_mesh(), end.surface.name)
            places = there.to_file(f.places(here.to_surface(places), back=back))
        return places

    def transfer(self, values: np.ndarray, *, back: bool = False) -> np.ndarray:
        """As :meth:`SurfaceMap.transfer`."""
        return transferred(self, values, back)

    def matrix(self) -> csr_matrix:
        """As :meth:`SurfaceMap.matrix`."""
        return correspondence_matrix(self)


def transferred(f: SurfaceMap | ComposedMap, values: np.ndarray, back: bool) -> np.ndarray:
    """Values at the vertices of one file, interpolated at those of the other.

    Raises:
        NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
    """
    start = f.target if back else f.source
    values = as_values(values, "values to transfer")
    check_rows(start.surface, values)
    faces = start.file_mesh()[1]
    places = f.correspondences(back=not back)
    if np.issubdtype(values.dtype, np.integer) or values.dtype == bool:
        best = places.weights.argmax(axis=1)
        return _labelled(values[faces[places.face, best]], places.face < 0)
    return places.take(values, faces)


def _labelled(values: np.ndarray, absent: np.ndarray) -> np.ndarray:
    """Labels (W, ...) with -1, or False, in the rows of a mask (W,)."""
    if not absent.any():
        return values
    if values.dtype.kind == "u":
        values = values.astype(np.int64)
    values[absent] = False if values.dtype == bool else -1
    return values


def correspondence_matrix(f: SurfaceMap | ComposedMap) -> csr_matrix:
    """The matrix (W, V) that interpolates values at the source's vertices at the points that the
    target's correspond to."""
    face, weights = f.correspondences(back=True)
    there = np.flatnonzero(face >= 0)
    columns = f.source.file_mesh()[1][face[there]]
    rows = np.repeat(there, 3)
    shape = (len(face), len(f.source.surface.cut_vertex))
    return csr_matrix((weights[there].ravel(), (rows, columns.ravel())), shape=shape)


def write_correspondences(path: str | Path, f: SurfaceMap | ComposedMap) -> None:
    """Write where the vertices of both mesh files go, as an .npz file.

    ``source_to_target_vertices`` (W, 3) are the vertices of the target's file at the corners of the
    face ``source_to_target_face`` (W,) that each vertex of the source's file goes to, and
    ``source_to_target_barycentric`` (W, 3) their weights; ``target_to_source_...`` the same for
    each vertex of the target's file. Of a source that is a part, vertices of the target without a
    preimage have -1 and NaN there.

    Raises:
        OSError: the folder cannot be written.
    """
    arrays: dict[str, Any] = {}
    for name, end, back in (
        ("source_to_target", f.target, False),
        ("target_to_source", f.source, True),
    ):
        face, weights = f.correspondences(back=back)
        arrays[f"{name}_face"] = face
        arrays[f"{name}_vertices"] = np.where(face[:, None] < 0, -1, end.file_mesh()[1][face])
        arrays[f"{name}_barycentric"] = weights
    data = io.BytesIO()
    np.savez_compressed(data, **arrays)
    atomic_write(path, data.getvalue())


def composed(after: SurfaceMap | ComposedMap, before: SurfaceMap | ComposedMap) -> ComposedMap:
    """x ↦ after(before(x)).

    Raises:
        NsmError: ``wrong_mesh``: the first ends on another mesh than the second starts from.
    """
    end, start = before.target, after.source
    if not same_mesh(end, start):
        raise NsmError(
            f"g @ f: f ends on {end.surface.name}, but g starts from another mesh, "
            f"{start.surface.name}; compose maps that share this mesh",
            kind="wrong_mesh",
            key=start.surface.name,
        )
    maps = [one.maps if isinstance(one, ComposedMap) else (one,) for one in (before, after)]
    return ComposedMap((*maps[0], *maps[1]))
