"""Maps between surfaces, and what they transfer."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from torch import nn

from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.results.artifact import NeuralSurface, load_surface, save_surface
from nsm.results.certificate import Correction, certificate, repaired, statement
from nsm.results.files import DAMAGE, damaged, read_pair, write_pair
from nsm.results.metrics import evaluate
from nsm.results.networks import placed_map
from nsm.results.points import as_points, as_values
from nsm.results.textured_mesh import LARGEST_SIZE, TexturedMesh, painted, read_file_mesh
from nsm.results.welding import Weld, weld
from nsm.surfaces.location import Places, locate
from nsm.surfaces.textures import read_texture

FORMAT = "nsm-surface-map"
STEM = "pair"


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """A map f from one surface to another, f∘φ = ψ∘h.

    Points are in the units and place of the mesh files. h is linear on each triangle of the source,
    so that a certificate of the vertices holds for every point. Points of the surfaces are looked
    up on the meshes; the networks φ and ψ only served to find h.

    Attributes:
        source, target: the neural surfaces φ and ψ.
        map: h, from the source's domain to the target's, frozen.
        landmarks: (L, 2) vertices of the two mesh files.
        metrics: figures of :func:`nsm.results.pair_metrics`.
        config: the settings of the run that made it.
        correction: vertices of the source that :meth:`repaired` moved, and where to.
        vertex_image: (V, 2) values of h at the source's vertices, where they are known already.
    """

    source: NeuralSurface
    target: NeuralSurface
    map: nn.Module = field(repr=False)
    landmarks: np.ndarray = field(repr=False)
    metrics: dict[str, float] = field(default_factory=dict, repr=False)
    config: dict[str, Any] = field(default_factory=dict, repr=False)
    correction: Correction = field(default_factory=Correction, repr=False)
    vertex_image: np.ndarray | None = field(default=None, repr=False)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) anywhere on the source surface to points (N, 3) of the target.

        Points off the source start from the nearest point on it.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        s, t = self.source.surface, self.target.surface
        image = _located(s, points, "points on the source").take(self.image_uv, s.faces)
        return self.target.in_original_units(t.at(image))

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) anywhere on the target to those (N, 3) of the source that f sends there.

        Points off the target start from the nearest point on it.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        s, t = self.source.surface, self.target.surface
        uv = _located(t, points, "points on the target").take(t.uv, t.faces)
        preimage = s.domain.carried(uv, self.image_uv, s.uv, s.faces, s.seam_pairs)
        return self.source.in_original_units(s.at(preimage))

    def planar(self, uv: np.ndarray) -> np.ndarray:
        """Points (N, 2) of the source's domain to those of the target's, (N, 2).

        On a closed domain, points in any lift, and images in the lifts that h sends them to.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        s = self.source.surface
        uv = as_points(uv, 2, "points of the domain")
        return s.domain.carried(uv, s.uv, self.image_uv, s.faces, s.seam_pairs)

    @cached_property
    def _uncorrected(self) -> np.ndarray:
        if self.vertex_image is not None:
            return self.vertex_image
        s = self.source.surface
        return s.domain.copied(s.uv, s.seam_pairs, evaluate(self.map, s.uv))

    @cached_property
    def image_uv(self) -> np.ndarray:
        """Images (V, 2) of the source's vertices in the target's domain, with the correction."""
        return self.correction.of(self._uncorrected)

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """Whether the map to the target's domain is injective (see :func:`certificate`)."""
        s = self.source.surface
        return certificate(s.domain, self.image_uv, s.faces, rest=s.uv, copies=s.seam_pairs)

    @property
    def statement(self) -> str:
        """What the certificate says, if it holds."""
        s = self.source.surface
        return statement(s.domain, seam=len(s.seam_pairs) > 0)

    def repaired(self) -> SurfaceMap:
        """The map with its flipped triangles turned back and its boundary put in order, where
        possible; landmarks move only if flips remain otherwise. ``metrics`` are not updated."""
        s = self.source.surface
        held = np.isin(s.source_vertex, s.kept(self.landmarks[:, 0].tolist()))
        better = repaired(s.domain, s.uv, s.faces, self.image_uv, held, s.seam_pairs)
        correction = Correction.between(self.image_uv, better, self.correction)
        return replace(self, correction=correction, vertex_image=self._uncorrected)

    @cached_property
    def image(self) -> np.ndarray:
        """Images (V, 3) of the cut source's vertices on the target, in normalised units."""
        return self.target.surface.at(self.image_uv)

    def places(self, given: Places, *, back: bool = False) -> Places:
        """Where places on the source's mesh go on the target's, or, with ``back``, come from.

        Args:
            given: faces and barycentric coordinates on ``source.surface``, or on
                ``target.surface`` with ``back``.
        """
        s, t = self.source.surface, self.target.surface
        if back:
            return s.domain.locate(given.take(t.uv, t.faces), self.image_uv, s.faces)
        return t.domain.locate(given.take(self.image_uv, s.faces), t.uv, t.faces)

    @cached_property
    def weld(self) -> Weld:
        """The image with one point for all copies of a seam vertex (see :func:`weld`); copies of a
        landmark go where its first one goes."""
        s, t = self.source.surface, self.target.surface
        kept = np.unique(s.cut_vertex[self.landmarks[:, 0]])
        return weld(s, t, self._forth, kept)

    @cached_property
    def welded_image(self) -> np.ndarray:
        """Images (W, 3) of the mesh file's vertices on the target, welded, in normalised units;
        with the faces of ``weld`` the image of a closed mesh is closed."""
        return by_file_vertex(self.source.surface, self.weld.points)

    @cached_property
    def _forth(self) -> Places:
        t = self.target.surface
        return t.domain.locate(self.image_uv, t.uv, t.faces)

    @cached_property
    def _back(self) -> Places:
        s, t = self.source.surface, self.target.surface
        return s.domain.locate(t.uv, self.image_uv, s.faces)

    @cached_property
    def source_uv(self) -> np.ndarray:
        """h⁻¹ at the target's vertices (of the cut mesh): (V, 2) in the source's domain."""
        s, t = self.source.surface, self.target.surface
        return s.domain.carried(t.uv, self.image_uv, s.uv, s.faces, s.seam_pairs)

    def transfer(self, values: np.ndarray, *, back: bool = False) -> np.ndarray:
        """Transfer values at the source's vertices to the target's, or back.

        Args:
            values: (V, ...) a row for each vertex of the mesh file; integers are labels, which are
                not interpolated.
            back: from the target to the source.

        Returns:
            (W, ...) a row for each vertex of the other mesh file (see :func:`by_file_vertex`).

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
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

    def bake(
        self,
        source: str | Path,
        target: str | Path,
        *,
        texture: str | Path | None = None,
        back: bool = False,
        size: int = 1024,
    ) -> TexturedMesh:
        """The texture of one mesh on the other: each texel has the colour of its preimage.

        Args:
            source, target: the mesh files, or names of the catalogue, that the map was made from.
            texture: an image for the texture coordinates of the mesh that it is carried from; by
                default that file's own materials.
            back: from the target to the source.
            size: texels a side of the new image, 1 to 8192.

        Returns:
            The target's mesh, or the source's with ``back``: ``.export("painted.glb")`` writes it.

        Raises:
            NsmError: ``missing_uv``, ``missing_texture`` or ``missing_file`` of the mesh that the
                texture is on; ``wrong_mesh`` for other meshes than the map's; ``out_of_range``.
        """
        if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= LARGEST_SIZE:
            message = f"size: {size!r} is not a whole number from 1 to {LARGEST_SIZE}"
            raise NsmError(message, kind="out_of_range", key="size")
        ends = [target, source] if back else [source, target]
        paint = read_texture(ends[0], texture)
        start, end = (read_file_mesh(one) for one in ends)
        return painted(self, start, paint, end, back=back, size=size)

    def matrix(self) -> csr_matrix:
        """The matrix (W, V) that :meth:`transfer` applies to values at the source's vertices.

        Rows belong to vertices of the target's mesh file, columns to those of the source's. Rows
        have a sum of one and no negative entries.
        """
        s, t = self.source.surface, self.target.surface
        ids = np.arange(len(t.vertices))
        columns = s.faces[self._back.face]
        blend = csr_matrix(
            (self._back.weights.ravel(), (np.repeat(ids, 3), columns.ravel())),
            shape=(len(ids), len(s.vertices)),
        )
        return csr_matrix(blend[by_file_vertex(t, ids)] @ cut_mesh_matrix(s))

    def morph(self, t: float) -> np.ndarray:
        """Vertices (V, 3) on straight lines from the source (t = 0) to the target (t = 1).

        In normalised units; a rigid motion first aligns the target with the source.

        Raises:
            NsmError: ``wrong_type``: t is not a finite number.
        """
        if not isinstance(t, Real) or not math.isfinite(t):
            message = f"morph: {t!r} is not a number from 0 to 1"
            raise NsmError(message, kind="wrong_type", key="t")
        return (1 - t) * self.source.surface.vertices + t * self.aligned_image

    @cached_property
    def aligned_image(self) -> np.ndarray:
        """The image (V, 3), aligned with the source by a rigid motion."""
        return self.aligned(self.image)

    def aligned(self, points: np.ndarray) -> np.ndarray:
        """Normalised points (N, 3) near the target, under that rigid motion (Kabsch's algorithm).

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
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
        tensors = {**self.map.state_dict(), **self.correction.tensors()}
        metadata = {
            "map": self.map.inner.config,  # type: ignore[union-attr]
            "landmarks": self.landmarks.tolist(),
            "metrics": self.metrics,
            "config": self.config,
        }
        write_pair(place / STEM, FORMAT, tensors, metadata)


def load_surface_map(folder: str | Path, trust: Iterable[str] = ()) -> SurfaceMap:
    """Read what :meth:`SurfaceMap.save` wrote.

    Args, Raises:
        as for :func:`nsm.results.load_surface`.
    """
    place = Path(folder)
    tensors, metadata = read_pair(place / STEM, FORMAT)
    source, target = (load_surface(place / end, trust) for end in ("source", "target"))
    try:
        correction = Correction.taken(tensors, len(source.surface.vertices))
        h = placed_map(metadata["map"], tensors, trust)
        landmarks = np.array(metadata["landmarks"], dtype=np.int64).reshape(-1, 2)
        metrics, config = dict(metadata["metrics"]), dict(metadata["config"])
    except DAMAGE as error:
        raise damaged(place / STEM, error) from error
    return SurfaceMap(source, target, h, landmarks, metrics, config, correction)


def by_file_vertex(surface: Surface, values: np.ndarray) -> np.ndarray:
    """Values at the cut mesh's vertices (V, ...) as values at the mesh file's (W, ...).

    A seam vertex takes the value of its first copy, a merged vertex that of the vertex it was
    merged with, and a vertex that is not on the surface that of the one with the nearest number.
    """
    row = surface.cut_vertex
    present = np.flatnonzero(row >= 0)
    nearest = present[np.searchsorted(present, np.arange(len(row))).clip(max=len(present) - 1)]
    return values[row[nearest]]


def on_cut_mesh(surface: Surface, values: np.ndarray) -> np.ndarray:
    """Values at the mesh file's vertices (W, ...) as values at the cut mesh's (V, ...).

    Vertices that were inserted between others take the mean of their neighbours, or a label of one.

    Raises:
        NsmError: ``wrong_shape``: not a row for each vertex of the file.
    """
    needed = len(surface.cut_vertex)
    if values.ndim == 0 or len(values) != needed:
        rows = 0 if values.ndim == 0 else len(values)
        message = f"{surface.name} has {needed} vertices, but {rows} rows were given"
        raise NsmError(message, kind="wrong_shape", key=surface.name)
    result = values[np.maximum(surface.source_vertex, 0)]
    whole = np.issubdtype(values.dtype, np.integer) or values.dtype == bool
    for vertex, around in _inserted(surface):
        result[vertex] = result[around[0]] if whole else result[around].mean(axis=0)
    return result


def cut_mesh_matrix(surface: Surface) -> csr_matrix:
    """What :func:`on_cut_mesh` does to numbers, as a matrix (V, W)."""
    known = np.flatnonzero(surface.source_vertex >= 0)
    rows, columns, weights = [known], [surface.source_vertex[known]], [np.ones(len(known))]
    for vertex, around in _inserted(surface):
        rows.append(np.full(len(around), vertex))
        columns.append(surface.source_vertex[around])
        weights.append(np.full(len(around), 1 / len(around)))
    entries = (np.concatenate(rows), np.concatenate(columns))
    shape = (len(surface.vertices), len(surface.cut_vertex))
    return csr_matrix((np.concatenate(weights), entries), shape=shape)


def _inserted(surface: Surface) -> Iterator[tuple[int, np.ndarray]]:
    """Each vertex that was inserted between others, and its neighbours (N,) of the mesh file."""
    for vertex in np.flatnonzero(surface.source_vertex < 0).tolist():
        around = np.unique(surface.faces[(surface.faces == vertex).any(axis=1)])
        yield vertex, around[surface.source_vertex[around] >= 0]


def _located(surface: Surface, points: np.ndarray, what: str) -> Places:
    """The places on a surface's mesh nearest to points (N, 3) in the units of its file."""
    points = as_points(points, 3, what)
    with np.errstate(over="ignore"):  # of points far away
        normalised = (points - surface.center) * surface.scale
    return locate(normalised, surface.vertices, surface.faces)
