"""The prepared surface: a mesh with injective coordinates in a domain Ω."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from nsm.domains.base import Domain, Keys
from nsm.domains.caps import without_caps
from nsm.domains.embedding import GIVEN
from nsm.domains.laid_out import closed_laid_out, cut_laid_out
from nsm.domains.layout import Layout
from nsm.domains.names import domain as domain_of
from nsm.domains.names import stored as stored_domain
from nsm.domains.preparation import Preparation, vertex_numbers
from nsm.errors import NsmError
from nsm.surfaces import cache as cache_
from nsm.surfaces import holes, topology
from nsm.surfaces.cutting import Cut, chords_joined, first_copies, seam_pairs
from nsm.surfaces.given import given_mesh
from nsm.surfaces.location import Locator
from nsm.surfaces.textures import read_uv
from nsm.surfaces.validation import NO_DECISION, CleanMesh, Repairs

ARRAYS = ("vertices", "faces", "uv", "source_vertex", "cut_vertex", "seam_pairs", "center")
OPTIONAL = ("lattice", "ends", "caps", "given_uv")
_LARGE = 200_000  # faces

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh, normalised and parameterised injectively into Ω.

    For a domain with boundary it is cut to a disc. On a closed domain it is whole: φ gives all
    copies of a vertex one point. A vertex has a copy for each of its lifts that a triangle needs,
    so that the three corners of each triangle are in one piece of the plane.

    Attributes:
        name: in logs and file names.
        vertices: (V, 3) float64, centred, scaled so that the area is that of Ω.
        faces: (F, 3) int64, counter-clockwise in Ω.
        uv: (V, 2) float64 in Ω, or near it on a closed domain, without flipped triangles.
        domain: Ω.
        source_vertex: (V,) int64, the vertex of the mesh file, or -1 for inserted points; -2, -3,
            ... in the middle of each hole that was filled.
        cut_vertex: (W,) int64, for each vertex of the mesh file its first copy here (or that of
            the vertex it was merged with); -1 if it is not on the surface.
        seam_pairs: (T, 2) int64, pairs of vertices that are copies of one point of the mesh.
        scale, center: ``vertices = (original - center) * scale``.
        quality: figures of the preparation (see :meth:`from_arrays`).
        log: repairs, conversions and cuts, a line each.
        lattice: (2, 2) on a closed domain: the surface is least distorted in the plane of
            (lattice / 2) uv, where it has the area of Ω. None elsewhere.
        ends: of open meshes cut together, (1 + J,) int64: a number that is the same for all of
            these, and the vertices of the mesh file at which the cuts end on the boundaries, which
            correspond. None elsewhere.
        caps: (F,) bool, the faces of caps that close the boundaries of a part for a map into a
            whole shape (see :attr:`part`); None: there are none.
        given_uv: (V, 2) the texture coordinates that its layout starts from, counter-clockwise,
            scaled as a whole to the area of Ω. None without ``parameterization="given"``.
        raw: the mesh (W, 3), (G, 3) as it was given, from which a map prepares it again; None for
            an analytic surface, and for one that an older version stored.
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
    lattice: np.ndarray | None = field(default=None, repr=False)
    ends: np.ndarray | None = field(default=None, repr=False)
    caps: np.ndarray | None = field(default=None, repr=False)
    given_uv: np.ndarray | None = field(default=None, repr=False)
    raw: tuple[np.ndarray, np.ndarray] | None = field(default=None, repr=False)
    _made: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def load(
        cls,
        path_or_name: Any,
        *,
        domain: str | Domain = "disc",
        seam_vertices: Sequence[int] | None = None,
        cones: Sequence[int] | None = None,
        parameterization: str = "slim",
        cache: bool = True,
        repairs: Repairs = NO_DECISION,
    ) -> Surface:
        """Load a mesh file, or a mesh of the catalogue by name, and prepare it.

        Args:
            path_or_name: an OBJ, PLY, OFF, STL, GLTF or GLB file, or a catalogue name; also an
                object of trimesh, or a pair of arrays (V, 3), (F, 3).
            domain: Ω, or the name of one of :data:`nsm.domains.DOMAINS`.
            seam_vertices: vertices (numbers in the file) that the seam passes through; by default
                mutually far ones where a seam is needed.
            cones: for ``domain="orbifold"``, the four vertices (numbers in the file) at its cones,
                in the order of (0, 0), (1, 0), (1, 1), (0, 1); by default extremities for which the
                surface is least distorted.
            parameterization: ``slim`` or ``tutte``, or ``given``: the file's texture coordinates;
                closed domains have ``slim`` only.
            cache: keep the prepared surface on disk, keyed by content.
            repairs: decisions on a mesh that is not one manifold.

        Raises:
            NsmError: no such file or name, or a mesh that cannot be prepared.
        """
        if isinstance(path_or_name, Surface):
            raise NsmError(
                f"{path_or_name.name}: it is prepared already; give its mesh file or arrays",
                kind="wrong_type",
                key="path_or_name",
            )
        mesh = given_mesh(path_or_name, "path_or_name")
        file = path_or_name if isinstance(path_or_name, (str, Path)) else ""
        uv = read_uv(file) if parameterization == GIVEN and Path(file).is_file() else None
        return cls.from_arrays(
            mesh.vertices,
            mesh.faces,
            name="mesh" if mesh.name == "path_or_name" else mesh.name,
            domain=domain,
            seam_vertices=seam_vertices,
            cones=cones,
            parameterization=parameterization,
            cache=cache,
            log=mesh.log,
            repairs=repairs,
            uv=uv,
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
        cones: Sequence[int] | None = None,
        parameterization: str = "slim",
        cache: bool = False,
        log: Sequence[str] = (),
        repairs: Repairs = NO_DECISION,
        uv: np.ndarray | None = None,
        off_seam: Sequence[int] = (),
    ) -> Surface:
        """Validate, cut, normalise and parameterise a mesh (V, 3), (F, 3).

        The arguments are those of :meth:`load`; ``uv`` (F, 3, 2) are texture coordinates at the
        faces' corners, for ``parameterization="given"``; ``off_seam`` are vertices that the seam of
        a domain with boundary goes around where it can. ``quality`` holds flipped_triangles,
        median_symmetric_dirichlet (of the map from Ω to the mesh) and seconds; on a domain with
        boundary also boundary_self_intersections, tutte_median_symmetric_dirichlet (for large
        meshes, Tutte's of the coarse mesh) and seam_vertices (the number of ``seam_pairs``). No
        triangle is flipped and the boundary does not cross itself, or this raises.

        Raises:
            NsmError: the mesh cannot be repaired, cut or flattened without flips;
                ``wrong_topology`` for a closed domain of another topology; ``wrong_domain`` for
                ``seam_vertices`` or ``cones`` where the domain has none.
        """
        asked = Preparation.checked(
            vertices,
            faces,
            name=name,
            domain=domain,
            method=parameterization,
            seam_vertices=seam_vertices,
            cones=cones,
            off_seam=off_seam,
            repairs=repairs,
            uv=uv,
        )
        key = asked.key() if cache else ""
        stored = cache_.read(key) if cache else None
        if stored is not None:
            surface = cls.from_stored(name, asked.domain, stored)
        else:
            surface = cls(**asked.fields(log))
            if cache:
                cache_.write(key, surface.to_stored())
        return replace(surface, raw=(asked.vertices, asked.faces))

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
        given: np.ndarray | None = None,
    ) -> Surface:
        """Normalise and parameterise a mesh that is a disc already.

        Args:
            cut: the disc, with the vertices of the whole mesh that its own came from.
            mesh: the whole mesh.
            keys: boundary vertices held at given places of ∂Ω.
            given: (V, 2) the disc in the plane, from which its layout starts.
            name, domain, parameterization, log: as for :meth:`from_arrays`.

        Raises:
            NsmError: the mesh cannot be flattened without flips.
        """
        return cls(
            **cut_laid_out(
                cut,
                mesh,
                name=name,
                domain=domain_of(domain),
                parameterization=parameterization,
                log=log,
                keys=keys,
                given=given,
            )
        )

    @classmethod
    def from_closed(
        cls,
        mesh: CleanMesh,
        *,
        name: str = "mesh",
        domain: str | Domain = "orbifold",
        parameterization: str = "slim",
        cones: Sequence[int] | None = None,
        log: Sequence[str] = (),
    ) -> Surface:
        """Normalise a closed mesh and lay it out on a closed domain.

        Args:
            mesh: the mesh.
            cones: vertices of it.
            name, domain, parameterization, log: as for :meth:`from_arrays`.

        Raises:
            NsmError: see :meth:`nsm.domains.orbifold.domain.ClosedDomain.embed`.
        """
        return cls(
            **closed_laid_out(
                mesh,
                name=name,
                domain=domain_of(domain),
                parameterization=parameterization,
                log=log,
                cones=cones,
            )
        )

    def to_stored(self) -> dict[str, np.ndarray]:
        """The arrays from which :meth:`from_stored` makes the surface, given name and domain."""
        details = json.dumps({"quality": self.quality, "log": self.log, "scale": self.scale})
        arrays = self.arrays()
        return {**arrays, "words": np.frombuffer(details.encode(), dtype=np.uint8)}

    @classmethod
    def from_stored(cls, name: str, domain: str | Domain, stored: dict[str, np.ndarray]) -> Surface:
        """The surface of arrays that :meth:`to_stored` gave."""
        details: dict[str, Any] = json.loads(stored["words"].tobytes())
        arrays: dict[str, Any] = {n: stored[n] for n in (*ARRAYS, *OPTIONAL) if n in stored}
        return cls(
            name=name,
            domain=domain_of(domain),
            scale=details["scale"],
            quality=details["quality"],
            log=(*details["log"], "prepared surface taken from the cache"),
            **arrays,
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of :data:`ARRAYS`, and those of :data:`OPTIONAL` that are there."""
        every = {name: getattr(self, name) for name in (*ARRAYS, *OPTIONAL)}
        return {name: array for name, array in every.items() if array is not None}

    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """The mesh as it was before copies were made, of a closed domain's surface.

        Returns:
            the first copies (W,) of the mesh file's vertices, in its order, without those that
            were removed, and then those in filled holes; and faces (F, 3) of numbers among these.
        """
        source, last = self.source_vertex, int(self.source_vertex.max())
        order = np.where(source < 0, last - source, source)
        _, first, number = np.unique(order, return_index=True, return_inverse=True)
        return first, number.reshape(-1)[self.faces]

    def file_faces(self) -> tuple[np.ndarray, np.ndarray]:
        """The faces before copies were made and points inserted, without filled holes.

        Returns:
            Faces (G, 3) of vertices of the mesh file, and the same (G, 3) of vertices here.
        """
        corners = chords_joined(self.faces, self.source_vertex == -1)[0]
        corners = corners[(self.source_vertex[corners] >= 0).all(axis=1)]
        return self.source_vertex[corners], corners

    @property
    def filled(self) -> np.ndarray:
        """Mask (F,) of the faces over holes that were filled."""
        if self.source_vertex.min() > holes.FIRST:
            return np.zeros(len(self.faces), dtype=bool)
        joined, _, number = chords_joined(self.faces, self.source_vertex == -1)
        return np.asarray((self.source_vertex[joined] <= holes.FIRST).any(axis=1)[number])

    def shown(self) -> tuple[np.ndarray, np.ndarray]:
        """What files have of the mesh: vertices (W,), and faces (F, 3) of numbers among them.

        Those of the cut mesh, or, on a closed domain, of :meth:`whole`, without filled holes.
        """
        vertices, faces = np.arange(len(self.vertices)), self.faces
        if not self.domain.has_boundary:
            vertices, faces = self.whole()
        filled = self.filled
        if not filled.any():
            return vertices, faces
        used, number = topology.renumbered(faces[~filled], len(vertices))
        return vertices[used], number[faces[~filled]]

    @cached_property
    def part(self) -> Surface:
        """The surface without caps, in its place and unit; itself, if it has none.

        There a map is measured and drawn; on the closed domain it has a boundary.
        """
        if self.caps is None:
            return self
        arrays: dict[str, Any] = without_caps(self)
        return replace(self, **arrays, caps=None)

    @cached_property
    def of_part(self) -> np.ndarray:
        """The vertices (W,) of :attr:`part`: those of faces that are no caps."""
        every = np.arange(len(self.vertices))
        return every if self.caps is None else np.unique(self.faces[~self.caps])

    @property
    def topology(self) -> tuple[int, int]:
        """Genus and number of boundary loops of the mesh before it was cut."""
        n = len(self.vertices)
        a, b = self.seam_pairs.T
        joined = csr_matrix((np.ones(len(a)), (a, b)), shape=(n, n))
        first = connected_components(joined, directed=False)[1]
        return topology.genus_and_boundary(first[self.faces])

    def at(self, uv: np.ndarray) -> np.ndarray:
        """The points (N, 3) of the mesh, in normalised units, at points (N, 2) of Ω."""
        return self.layout.locate(uv).take(self.vertices, self.faces)

    @property
    def layout(self) -> Layout:
        """The mesh over Ω, on which points of Ω are looked up."""
        return self._kept("layout", lambda: self.domain.layout(self.uv, self.faces))

    @property
    def locator(self) -> Locator:
        """The mesh in space without caps, on which points near it are looked up."""
        faces = self.faces if self.caps is None else self.faces[~self.caps]
        return self._kept("locator", lambda: Locator(self.vertices, faces))

    def _kept(self, name: str, make: Callable[[], T]) -> T:
        """What ``make()`` makes of the mesh, for the next call too; of a large mesh for one call,
        as it takes more memory than the mesh."""
        if len(self.faces) > _LARGE:
            return make()
        if name not in self._made:
            self._made[name] = make()
        made: T = self._made[name]
        return made

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
        numbers = vertex_numbers(vertex_ids, f"{self.name}: vertices")
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
    *,
    origin: np.ndarray | None = None,
    lattice: np.ndarray | None = None,
) -> Surface:
    """A surface from a mesh that is laid out already, not scaled and not checked.

    Args:
        name, vertices, faces, uv, domain, lattice: as in the surface.
        origin: (V,) numbers, equal for copies of one vertex; by default there are no copies.
    """
    origin = np.arange(len(uv)) if origin is None else origin
    return Surface(
        name=name,
        vertices=vertices,
        faces=faces,
        uv=uv,
        domain=domain_of(domain),
        source_vertex=origin,
        cut_vertex=first_copies(origin, int(origin.max()) + 1),
        seam_pairs=seam_pairs(origin),
        scale=1.0,
        center=np.zeros(3),
        lattice=lattice,
    )
