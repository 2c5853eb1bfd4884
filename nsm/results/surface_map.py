"""Maps between surfaces, and what they transfer."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor, nn

from nsm.domains import Layout
from nsm.domains.caps import off_rims, on_caps
from nsm.errors import NsmError
from nsm.results.artifact import NeuralSurface, save_surface
from nsm.results.certificate import INTO, Correction, certificate, repaired, statement
from nsm.results.composed_map import ComposedMap, composed, correspondence_matrix, transferred
from nsm.results.devices import as_device
from nsm.results.evaluation import evaluate_double
from nsm.results.file_faces import FileFaces
from nsm.results.files import write_pair
from nsm.results.morph_target import write_morph
from nsm.results.points import as_points
from nsm.results.pointwise import (
    SurfaceMapModule,
    fixed_image,
    located,
    moved,
    planar_moved,
    value_and_jacobian,
)
from nsm.results.reliability import Reliability, reliability
from nsm.results.textured_mesh import TexturedMesh, painted_by
from nsm.results.vertex_values import by_file_vertex
from nsm.results.welding import Weld, weld
from nsm.surfaces.location import Places

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

    @overload
    def __call__(self, points: np.ndarray) -> np.ndarray: ...
    @overload
    def __call__(self, points: Tensor) -> Tensor: ...
    def __call__(self, points: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """Points (N, 3) anywhere on the source surface to points (N, 3) of the target.

        Points off the source start from the nearest point on it. For a tensor the result is one of
        its type, on its device, with a gradient for the points; :meth:`module` has one for the
        weights of h too.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        if isinstance(points, Tensor):
            return moved(self, points, fixed_image(self))
        s, t = self.source.surface, self.target.surface
        image = located(s, points, "points on the source").take(self.image_uv, s.faces)
        return self.target.in_original_units(t.at(image))

    @overload
    def inverse(self, points: np.ndarray) -> np.ndarray: ...
    @overload
    def inverse(self, points: Tensor) -> Tensor: ...
    def inverse(self, points: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """Points (N, 3) anywhere on the target to those (N, 3) of the source that f sends there.

        Points off the target start from the nearest point on it. Where f sends no point of the
        source, a part, the result is NaN. Tensors as for :meth:`__call__`.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        if isinstance(points, Tensor):
            return moved(self, points, fixed_image(self), back=True)
        s, t = self.source.surface, self.target.surface
        uv = located(t, points, "points on the target").take(t.uv, t.faces)
        preimage = self.image_layout.carried(uv, s.uv, s.seam_pairs)
        found = off_rims(s, s.layout.locate(preimage))
        points = self.source.in_original_units(found.take(s.vertices, s.faces))
        points[on_caps(s, found.face)] = np.nan
        return points

    @overload
    def value_and_jacobian(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...
    @overload
    def value_and_jacobian(self, points: Tensor) -> tuple[Tensor, Tensor]: ...
    def value_and_jacobian(
        self, points: np.ndarray | Tensor
    ) -> tuple[np.ndarray, np.ndarray] | tuple[Tensor, Tensor]:
        """Images (N, 3) of points (N, 3) of the source, and Jacobians (N, 3, 3).

        A Jacobian takes tangent vectors of the source to tangent vectors of the target, in the
        units of the files, and the source's normal to zero. It is constant on the pieces of
        triangles on which the map is affine.

        Raises:
            NsmError: as :meth:`__call__`.
        """
        if isinstance(points, Tensor):
            return value_and_jacobian(self, points, fixed_image(self))
        given = torch.from_numpy(as_points(points, 3, "points on the source"))
        value, jacobian = value_and_jacobian(self, given, fixed_image(self))
        return value.numpy(), jacobian.numpy()

    def __matmul__(self, other: SurfaceMap | ComposedMap) -> ComposedMap:
        """``g @ f``, the map x ↦ g(f(x)), where f ends on the mesh that g starts from.

        Raises:
            NsmError: ``wrong_mesh``: f ends on another mesh.
        """
        return composed(self, other)

    def module(self) -> SurfaceMapModule:
        """f as a torch module on points (N, 3), whose weights, those of h, can be trained."""
        return SurfaceMapModule(self)

    def to(self, device: torch.device | str) -> SurfaceMap:
        """The same map with its networks on a device.

        Raises:
            NsmError: as :func:`nsm.results.devices.as_device`.
        """
        device = as_device(device)
        return replace(
            self,
            source=self.source.to(device),
            target=self.target.to(device),
            map=copy.deepcopy(self.map).to(device),
            vertex_image=self._uncorrected,
        )

    def correspondences(self, *, back: bool = False) -> Places:
        """Where each vertex of the source's mesh file goes on the mesh of the target's.

        The copies of a vertex on a seam have one image (see :attr:`weld`). Vertices that are not on
        the surface, such as those of a part that was left out, go with the nearest point on it.

        Args:
            back: where each vertex of the target's file comes from on the source's mesh.

        Returns:
            face (W,), the rows of ``target.file_mesh()``'s faces, and barycentric coordinates
            (W, 3) in them: ``face, weights = f.correspondences()``. With ``back``, a vertex of the
            target to which no point of the source, a part, goes has the face -1 and NaN.
        """
        return self._corresponding_back if back else self._corresponding

    @cached_property
    def _corresponding(self) -> Places:
        return self._on_file_faces(self.target, back=False)

    @cached_property
    def _corresponding_back(self) -> Places:
        return self._on_file_faces(self.source, back=True)

    def _on_file_faces(self, end: NeuralSurface, back: bool) -> Places:
        files = FileFaces(end.surface, *end.file_mesh(), end.surface.name)
        return files.to_file(self._of_file_vertices(back))

    def _of_file_vertices(self, back: bool) -> Places:
        start = self.target if back else self.source
        own = self._back if back else self.weld.places
        face, weights = (by_file_vertex(start.surface, array) for array in own)
        absent = np.flatnonzero(start.surface.cut_vertex < 0)
        if len(absent):
            points = start.file_mesh()[0][absent]
            near = self.places(located(start.surface, points, "vertices"), back=back)
            face[absent], weights[absent] = near
        return Places(face, weights)

    @overload
    def planar(self, uv: np.ndarray) -> np.ndarray: ...
    @overload
    def planar(self, uv: Tensor) -> Tensor: ...
    def planar(self, uv: np.ndarray | Tensor) -> np.ndarray | Tensor:
        """Points (N, 2) of the source's domain to those of the target's, (N, 2).

        On a closed domain, points in any lift, and images in the lifts that h sends them to. For a
        tensor the result is one of its type, on its device, with a gradient for the points: that of
        the triangle that each is in.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        if isinstance(uv, Tensor):
            return planar_moved(self, uv)
        s = self.source.surface
        uv = as_points(uv, 2, "points of the domain")
        return s.layout.carried(uv, self.image_uv, s.seam_pairs)

    @cached_property
    def _uncorrected(self) -> np.ndarray:
        if self.vertex_image is not None:
            return self.vertex_image
        s = self.source.surface
        return s.domain.copied(s.uv, s.seam_pairs, evaluate_double(self.map, s.uv))

    @cached_property
    def image_uv(self) -> np.ndarray:
        """Images (V, 2) of the source's vertices in the target's domain, with the correction."""
        return self.correction.of(self._uncorrected)

    @property
    def image_layout(self) -> Layout:
        """The source's mesh as the map lays it out over the target's domain. It is not kept: a
        collection has many maps."""
        s = self.source.surface
        return s.domain.layout(self.image_uv, s.faces)

    @cached_property
    def certificate(self) -> dict[str, Any]:
        """Whether the map to the target's domain is injective (see :func:`certificate`)."""
        s = self.source.surface
        return certificate(s.domain, self.image_uv, s.faces, rest=s.uv, copies=s.seam_pairs)

    @property
    def statement(self) -> str:
        """What the certificate says, if it holds.

        Of a part, closed by caps, all of it is certified, and so is the part within.
        """
        s = self.source.surface
        if s.caps is not None:
            return INTO
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
    def part(self) -> SurfaceMap:
        """The map of the source without caps, as it is measured and drawn; itself, if the source
        has none."""
        s = self.source.surface
        if s.caps is None:
            return self
        image = self.image_uv[s.of_part]
        source = replace(self.source, surface=s.part)
        return replace(self, source=source, vertex_image=image, correction=Correction())

    @cached_property
    def unreached(self) -> np.ndarray:
        """Mask (V,) of the vertices of the cut target to which no point of the source goes."""
        return on_caps(self.source.surface, self._back.face)

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
        absent = given.face < 0
        if absent.any():
            return given.where(~absent, lambda there: self.places(there, back=back))
        if back:
            return off_rims(s, self.image_layout.locate(given.take(t.uv, t.faces)))
        return t.layout.locate(given.take(self.image_uv, s.faces))

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
        t = self.target.surface
        return self._of_file_vertices(False).take(t.vertices, t.faces)

    @cached_property
    def _forth(self) -> Places:
        return self.target.surface.layout.locate(self.image_uv)

    @cached_property
    def _back(self) -> Places:
        s, t = self.source.surface, self.target.surface
        return off_rims(s, self.image_layout.locate(t.uv))

    @cached_property
    def source_uv(self) -> np.ndarray:
        """h⁻¹ at the target's vertices (of the cut mesh): (V, 2) in the source's domain.

        At those that are :attr:`unreached` too, where h⁻¹ is that of the closed source.
        """
        s, t = self.source.surface, self.target.surface
        return self.image_layout.carried(t.uv, s.uv, s.seam_pairs)

    def transfer(self, values: np.ndarray, *, back: bool = False) -> np.ndarray:
        """Transfer values at the source's vertices to the target's, or back.

        Args:
            values: (V, ...) a row for each vertex of the mesh file; integers are labels, which are
                not interpolated.
            back: from the target to the source.

        Returns:
            (W, ...) a row for each vertex of the other mesh file, interpolated where
            :meth:`correspondences` says. Vertices of the target to which no point of the source, a
            part, goes have NaN; of labels -1, and of truth values False.

        Raises:
            NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
        """
        return transferred(self, values, back)

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
        return painted_by(self, source, target, texture=texture, back=back, size=size)

    def matrix(self) -> csr_matrix:
        """The matrix (W, V) that :meth:`transfer` applies to values at the source's vertices.

        Rows belong to vertices of the target's mesh file, columns to those of the source's. Rows
        have a sum of one and no negative entries; they are zero for vertices to which no point of
        the source, a part, goes.
        """
        return correspondence_matrix(self)

    @cached_property
    def reliability(self) -> Reliability:
        """Figures at the vertices of the source's file that say where to trust the map."""
        return reliability(self)

    def morph(self, t: float) -> np.ndarray:
        """Vertices (W, 3) on straight lines from the source (t = 0) to its image (t = 1).

        They are those of the source's file, in its units; the image is scaled to the source's area
        and aligned with it by a rigid motion. :meth:`export_morph` leaves it in its place.

        Raises:
            NsmError: ``wrong_type``: t is not a finite number.
        """
        if not isinstance(t, Real) or not math.isfinite(t):
            message = f"morph: {t!r} is not a number from 0 to 1"
            raise NsmError(message, kind="wrong_type", key="t")
        end = self.source.in_original_units(self.aligned(self.welded_image))
        return (1 - t) * self.source.file_mesh()[0] + t * end

    def export_morph(self, path: str | Path) -> None:
        """Write a GLB file: the source's mesh, with its image on the target as morph target.

        Vertices and faces are those of the source's file. Both shapes have the units and place of
        their own files, in single precision; programs show the target as a shape key.

        Raises:
            NsmError: ``unknown_format``: the file's ending is not .glb; ``out_of_range``: a length
                exceeds single precision.
            OSError: the folder cannot be written.
        """
        write_morph(path, self)

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
        image, reference = self.part.image, self.part.source.surface.vertices
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
