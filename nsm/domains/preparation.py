"""From a mesh to what a surface holds: a request is checked, the mesh cleaned, cut, laid out."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nsm.domains.base import Domain
from nsm.domains.embedding import GIVEN, check_method
from nsm.domains.given_layout import check_given, cut_as_given
from nsm.domains.laid_out import closed_laid_out, cut_laid_out
from nsm.domains.names import domain as domain_of
from nsm.domains.names import stored as stored_domain
from nsm.errors import NsmError
from nsm.surfaces import cache
from nsm.surfaces.cutting import cut_to_disc
from nsm.surfaces.landmarks import listed
from nsm.surfaces.loading import as_arrays
from nsm.surfaces.validation import NO_DECISION, CleanMesh, Repairs, clean


@dataclass(frozen=True, eq=False)
class Preparation:
    """A mesh and how it is prepared: the arguments of :meth:`nsm.Surface.from_arrays`, checked.

    Attributes:
        name: in messages.
        vertices: (V, 3) float64.
        faces: (F, 3) int64.
        domain: Ω.
        method: ``slim``, ``tutte`` or ``given``.
        seam: vertices that the seam passes through; None: chosen.
        cones: vertices at the cones of the orbifold; None: chosen.
        off_seam: vertices that the seam goes around.
        repairs: decisions on a mesh that is not one manifold.
        uv: (F, 3, 2) texture coordinates of the method ``given``, else None.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    domain: Domain
    method: str
    seam: list[int] | None
    cones: list[int] | None
    off_seam: list[int]
    repairs: Repairs
    uv: np.ndarray | None

    @classmethod
    def checked(
        cls,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        name: str,
        domain: str | Domain,
        method: str,
        seam_vertices: Sequence[int] | None,
        cones: Sequence[int] | None,
        off_seam: Sequence[int],
        repairs: Repairs,
        uv: np.ndarray | None,
    ) -> Preparation:
        """What is asked for.

        Raises:
            NsmError: an argument that is wrong in itself, or ``wrong_domain`` for
                ``seam_vertices`` or ``cones`` where the domain has none.
        """
        domain = domain_of(domain)
        check_method(method, name)
        vertices, faces = as_arrays(vertices, faces, name)
        what = f"{name}: seam_vertices"
        seam = None if seam_vertices is None else vertex_numbers(seam_vertices, what)
        corners = None if cones is None else vertex_numbers(cones, f"{name}: cones")
        unused, key = (corners, "cones") if domain.has_boundary else (seam, "seam_vertices")
        if unused is not None:
            raise NsmError(
                f"{name}: domain={domain} has no {key.split('_')[0].rstrip('s')}; leave "
                f"surface.{key} out",
                kind="wrong_domain",
                key=f"surface.{key}",
            )
        return cls(
            name=name,
            vertices=vertices,
            faces=faces,
            domain=domain,
            method=method,
            seam=seam,
            cones=corners,
            off_seam=[int(v) for v in off_seam] if domain.has_boundary else [],
            repairs=repairs,
            uv=check_given(uv, faces, domain, seam, name) if method == GIVEN else None,
        )

    def key(self) -> str:
        """That of the prepared surface in :mod:`nsm.surfaces.cache`."""
        options = {
            "domain": stored_domain(self.domain),
            "seam": self.seam,
            "method": self.method,
        }
        if self.cones is not None:
            options["cones"] = self.cones
        if self.off_seam:
            options["off_seam"] = self.off_seam
        if self.repairs != NO_DECISION:
            options["repairs"] = asdict(self.repairs)
        if self.uv is not None:
            options["given_uv"] = hashlib.sha256(self.uv.tobytes()).hexdigest()
        return cache.preparation_key(self.vertices, self.faces, options)

    def fields(self, log: Sequence[str]) -> dict[str, Any]:
        """The fields of the surface, after the preparation.

        Args:
            log: lines on the mesh, before those of the preparation.

        Raises:
            NsmError: as :meth:`nsm.Surface.from_arrays`.
        """
        name = self.name
        mesh = clean(self.vertices, self.faces, name, self.repairs)
        about: dict[str, Any] = {
            "name": name,
            "domain": self.domain,
            "parameterization": self.method,
            "log": (*log, *mesh.log),
        }
        if self.uv is not None:
            cut, flat = cut_as_given(mesh, self.faces, self.uv, name)
            return cut_laid_out(cut, mesh, **about, given=flat)
        if not self.domain.has_boundary:
            corners = self.cones
            if corners is not None:
                corners = _merged(corners, mesh, name, "cones")
            return closed_laid_out(mesh, cones=corners, **about)
        seam = self.seam
        if seam is not None:
            seam = _merged(seam, mesh, name, "seam_vertices")
        around = _merged(self.off_seam, mesh, name, "off_seam")
        cut = cut_to_disc(mesh.vertices, mesh.faces, seam_vertices=seam, avoided=around, name=name)
        return cut_laid_out(cut, mesh, **about)


def vertex_numbers(given: Any, what: str) -> list[int]:
    """Vertex numbers; NsmError for anything but a list of whole numbers."""
    numbers = listed(given, what)
    if not isinstance(numbers, list):
        raise NsmError(f"{what}: give vertex numbers", kind="wrong_type", key=what)
    return numbers


def _merged(given: list[int], mesh: CleanMesh, name: str, key: str) -> list[int]:
    """Vertices of the mesh file as vertices of the cleaned mesh, or NsmError."""
    for vertex in given:
        if not 0 <= vertex < len(mesh.merged) or mesh.merged[vertex] < 0:
            raise NsmError(
                f"{name}: vertex {vertex} is not on the mesh "
                f"(vertices 0 to {len(mesh.merged) - 1}); give other {key}",
                kind="not_on_surface",
                key=key,
            )
    return mesh.merged[np.array(given, dtype=np.int64)].tolist()
