"""The prepared surface: a disc-shaped mesh with injective coordinates in a planar domain."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nsm.domains.base import Domain, Keys
from nsm.domains.embedding import check_method
from nsm.domains.names import domain as domain_of
from nsm.domains.names import stored as stored_domain
from nsm.domains.planar_mesh import boundary_self_intersections, flipped_triangles
from nsm.errors import NsmError
from nsm.surfaces import cache as cache_
from nsm.surfaces import topology
from nsm.surfaces.catalogue import catalogue_mesh
from nsm.surfaces.cutting import Cut, cut_to_disc, first_copies
from nsm.surfaces.landmarks import listed
from nsm.surfaces.loading import as_arrays, load_mesh
from nsm.surfaces.validation import CleanMesh, clean

ARRAYS = ("vertices", "faces", "uv", "source_vertex", "cut_vertex", "seam_pairs", "center")


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh cut to a disc, normalised, and parameterised injectively into Ω.

    Attributes:
        name: in logs and file names.
        vertices: (V, 3) float64, centred, scaled so that the area is that of Ω.
        faces: (F, 3) int64, counter-clockwise in Ω.
        uv: (V, 2) float64 in Ω, without flipped triangles.
        domain: Ω.
        source_vertex: (V,) int64, the vertex of the mesh file, or -1 for inserted points.
        cut_vertex: (W,) int64, for each vertex of the mesh file its first copy here (or that of
            the vertex it was merged with); -1 if it is not on the surface.
        seam_pairs: (T, 2) int64, pairs of vertices on the seam that are one point of the mesh.
        scale, center: ``vertices = (original - center) * scale``.
        quality: figures of the preparation (see :meth:`from_arrays`).
        log: repairs, conversions and cuts, a line each.
    """

    name: str
    vertices: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    uv: np.ndarray = field(repr=False)
    domain: Domain
    source_vertex: np.ndarray = field(repr=False)
    cut_vertex: np.ndarray = field(repr=False)
    seam_pairs: np.ndarray = field(repr=False)
    scale: float = field(repr=False)
    center: np.ndarray = field(repr=False)
    quality: dict[str, float] = field(default_factory=dict, repr=False)
    log: tuple[str, ...] = field(default=(), repr=False)

    @classmethod
    def load(
        cls,
        path_or_name: str | Path,
        *,
        domain: str | Domain = "disc",
        seam_vertices: Sequence[int] | None = None,
        parameterization: str = "slim",
        cache: bool = True,
    ) -> Surface:
        """Load a mesh file, or a mesh of the catalogue by name, and prepare it.

        Args:
            path_or_name: an OBJ, PLY, OFF, STL, GLTF or GLB file, or a catalogue name.
            domain: Ω, or the name of one of :data:`nsm.domains.DOMAINS`.
            seam_vertices: vertices (numbers in the file) that the seam passes through; by default
                mutually far ones where a seam is needed.
            parameterization: ``slim`` or ``tutte``.
            cache: keep the prepared surface on disk, keyed by content.

        Raises:
            NsmError: no such file or name, or a mesh that cannot be prepared.
        """
        if not isinstance(path_or_name, (str, Path)):
            kind = type(path_or_name).__name__
            raise NsmError(
                f"a {kind} is no mesh file; give its path, or the arrays to Surface.from_arrays",
                kind="wrong_type",
                key="path_or_name",
            )
        text = str(path_or_name)
        if Path(text).suffix or "/" in text or "\\" in text or Path(text).exists():
            vertices, faces, log = load_mesh(path_or_name)
            name = Path(text).stem
        else:
            vertices, faces = catalogue_mesh(text)
            name, log = text, ()
        return cls.from_arrays(
            vertices,
            faces,
            name=name,
            domain=domain,
            seam_vertices=seam_vertices,
            parameterization=parameterization,
            cache=cache,
            log=log,
        )

    @classmethod
    def from_arrays(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        name: str = "mesh",
        domain: str | Domain = "disc",
        seam_vertices: Sequence[int] | None = None,
        parameterization: str = "slim",
        cache: bool = False,
        log: Sequence[str] = (),
    ) -> Surface:
        """Validate, cut, normalise and parameterise a mesh (V, 3), (F, 3).

        ``quality`` holds flipped_triangles, boundary_self_intersections (both 0, or this raises),
        median_symmetric_dirichlet and tutte_median_symmetric_dirichlet (of the map from Ω to the
        mesh; for large meshes, Tutte's of the coarse mesh), seam_vertices (the number of
        ``seam_pairs``) and seconds.

        Raises:
            NsmError: the mesh cannot be repaired, cut or flattened without flips.
        """
        domain = domain_of(domain)
        check_method(parameterization, name)
        vertices, faces = as_arrays(vertices, faces, name)
        seam = None if seam_vertices is None else _numbers(seam_vertices, f"{name}: seam_vertices")
        options = {"domain": stored_domain(domain), "seam": seam, "method": parameterization}
        key = cache_.preparation_key(vertices, faces, options) if cache else ""
        stored = cache_.read(key) if cache else None
        if stored is not None:
            return cls.from_stored(name, domain, stored)
        mesh = clean(vertices, faces, name)
        if seam is not None:
            seam = _merged(seam, mesh, name)
        cut = cut_to_disc(mesh.vertices, mesh.faces, seam_vertices=seam, name=name)
        surface = cls.from_cut(
            cut,
            mesh,
            name=name,
            domain=domain,
            parameterization=parameterization,
            log=(*log, *mesh.log),
        )
        if cache:
            cache_.write(key, surface.to_stored())
        return surface

    @classmethod
    def from_cut(
        cls,
        cut: Cut,
        mesh: CleanMesh,
        *,
        name: str = "mesh",
        domain: str | Domain = "disc",
        parameterization: str = "slim",
        keys: Keys | None = None,
        log: Sequence[str] = (),
    ) -> Surface:
        """Normalise and parameterise a mesh that is a disc already.

        Args:
            cut: the disc, with the vertices of the whole mesh that its own came from.
            mesh: the whole mesh.
            keys: boundary vertices held at given places of ∂Ω.
            name, domain, parameterization, log: as for :meth:`from_arrays`.

        Raises:
            NsmError: the mesh cannot be flattened without flips.
        """
        start = time.perf_counter()
        domain = domain_of(domain)
        center = 0.5 * (cut.vertices.min(axis=0) + cut.vertices.max(axis=0))
        centred = cut.vertices - center
        area = float(topology.face_areas(centred, cut.faces).sum())
        scale = float(np.sqrt(domain.area / area))
        normalised = centred * scale
        flat = domain.embed(normalised, cut.faces, method=parameterization, name=name, keys=keys)
        flipped = flipped_triangles(flat.uv, cut.faces)
        crossings = boundary_self_intersections(flat.uv, cut.loop) if domain.has_boundary else 0
        if flipped or crossings:
            raise NsmError(
                f"{name}: the parameterization is not injective ({flipped} flipped triangles, "
                f"{crossings} boundary crossings); give seam_vertices at the tips of long parts",
                kind="not_injective",
                key=name,
            )
        source = np.where(cut.origin >= 0, mesh.source_vertex[cut.origin], -1)
        first = first_copies(cut.origin, len(mesh.vertices))
        quality = {
            "flipped_triangles": float(flipped),
            "boundary_self_intersections": float(crossings),
            "median_symmetric_dirichlet": flat.distortion,
            "tutte_median_symmetric_dirichlet": flat.tutte_distortion,
            "seam_vertices": float(len(cut.seam_pairs)),
            "seconds": time.perf_counter() - start,
        }
        return cls(
            name=name,
            vertices=normalised,
            faces=cut.faces,
            uv=flat.uv,
            domain=domain,
            source_vertex=source,
            cut_vertex=np.where(mesh.merged >= 0, first[mesh.merged], -1),
            seam_pairs=cut.seam_pairs,
            scale=scale,
            center=center,
            quality=quality,
            log=(*log, *cut.log, *flat.log),
        )

    def to_stored(self) -> dict[str, np.ndarray]:
        """The arrays from which :meth:`from_stored` makes the surface, given name and domain."""
        details = json.dumps({"quality": self.quality, "log": self.log, "scale": self.scale})
        arrays = {name: getattr(self, name) for name in ARRAYS}
        return {**arrays, "words": np.frombuffer(details.encode(), dtype=np.uint8)}

    @classmethod
    def from_stored(cls, name: str, domain: str | Domain, stored: dict[str, np.ndarray]) -> Surface:
        """The surface of arrays that :meth:`to_stored` gave."""
        details: dict[str, Any] = json.loads(stored["words"].tobytes())
        return cls(
            name=name,
            domain=domain_of(domain),
            scale=details["scale"],
            quality=details["quality"],
            log=(*details["log"], "prepared surface taken from the cache"),
            **{name: stored[name] for name in ARRAYS},
        )

    @property
    def bounding_box_diagonal(self) -> float:
        """Length of the bounding box's diagonal, in normalised units."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def content_key(self) -> str:
        """Hash of the geometry and its parameterization: equal surfaces, equal keys."""
        digest = hashlib.sha256(str(stored_domain(self.domain)).encode())
        for array in (self.vertices, self.uv):
            digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        digest.update(np.ascontiguousarray(self.faces, dtype="<i8").tobytes())
        return digest.hexdigest()[:32]

    def preimages(self, vertex_ids: Sequence[int]) -> np.ndarray:
        """Points (L, 2) of Ω for vertices of the mesh file; for a seam vertex, its first copy.

        Raises:
            NsmError: a vertex that the file does not have, or that was removed as bad.
        """
        return self.uv[self._found(vertex_ids)]

    def kept(self, vertex_ids: Sequence[int]) -> np.ndarray:
        """Vertices (L,) as in ``source_vertex``: merged ones as the vertex they were merged with.

        Raises:
            NsmError: as :meth:`preimages`.
        """
        return self.source_vertex[self._found(vertex_ids)]

    def _found(self, vertex_ids: Sequence[int]) -> np.ndarray:
        numbers = _numbers(vertex_ids, f"{self.name}: vertices")
        for vertex in numbers:
            if not 0 <= vertex < len(self.cut_vertex) or self.cut_vertex[vertex] < 0:
                raise NsmError(
                    f"{self.name}: vertex {vertex} is not on the surface "
                    f"(0 to {len(self.cut_vertex) - 1}); give another landmark",
                    kind="not_on_surface",
                    key=self.name,
                )
        return self.cut_vertex[np.array(numbers, dtype=np.int64)]


def as_it_lies(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    domain: str | Domain,
    seam_pairs: np.ndarray | None = None,
) -> Surface:
    """A surface from a mesh that is laid out already, not scaled and not checked."""
    return Surface(
        name=name,
        vertices=vertices,
        faces=faces,
        uv=uv,
        domain=domain_of(domain),
        source_vertex=np.arange(len(uv)),
        cut_vertex=np.arange(len(uv)),
        seam_pairs=np.zeros((0, 2), dtype=np.int64) if seam_pairs is None else seam_pairs,
        scale=1.0,
        center=np.zeros(3),
    )


def _numbers(given: Any, what: str) -> list[int]:
    """Vertex numbers; NsmError for anything but a list of whole numbers."""
    numbers = listed(given, what)
    if not isinstance(numbers, list):
        raise NsmError(f"{what}: give vertex numbers", kind="wrong_type", key=what)
    return numbers


def _merged(seam: list[int], mesh: CleanMesh, name: str) -> list[int]:
    """Seam vertices of the mesh file as vertices of the cleaned mesh, or NsmError."""
    for vertex in seam:
        if not 0 <= vertex < len(mesh.merged) or mesh.merged[vertex] < 0:
            raise NsmError(
                f"{name}: seam vertex {vertex} is not on the mesh "
                f"(vertices 0 to {len(mesh.merged) - 1}); give another seam_vertices",
                kind="not_on_surface",
                key="seam_vertices",
            )
    return mesh.merged[np.array(seam, dtype=np.int64)].tolist()
