"""A cleaned mesh, normalised and laid out over Ω: the fields of a surface."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from nsm.domains.base import Domain, Keys
from nsm.domains.given_layout import embedded_as_given, in_units_of
from nsm.domains.names import bounded
from nsm.domains.planar_mesh import boundary_self_intersections, flipped_triangles
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.cutting import Cut, first_copies, seam_pairs
from nsm.surfaces.validation import CleanMesh
from nsm.wording import number_of


def cut_laid_out(
    cut: Cut,
    mesh: CleanMesh,
    *,
    name: str,
    domain: Domain,
    parameterization: str,
    log: Sequence[str],
    keys: Keys | None = None,
    given: np.ndarray | None = None,
) -> dict[str, Any]:
    """The fields of :meth:`nsm.Surface.from_cut`, which explains the arguments.

    Raises:
        NsmError: the mesh cannot be flattened without flips.
    """
    start = time.perf_counter()
    centred, center, scale = _centred(cut.vertices, cut.faces, domain)
    normalised = centred * scale
    if given is None:
        how: dict[str, Any] = {"method": parameterization, "name": name, "keys": keys}
        flat = domain.embed(normalised, cut.faces, **how)
    else:
        flat = embedded_as_given(bounded(domain), cut, given, name)
        given = in_units_of(bounded(domain), given, cut.faces)
    flipped = flipped_triangles(flat.uv, cut.faces)
    crossings = boundary_self_intersections(flat.uv, cut.loop) if domain.has_boundary else 0
    if flipped or crossings:
        faults = f"{number_of(flipped, 'flipped triangle')}, "
        faults += number_of(crossings, "boundary crossing")
        raise NsmError(
            f"{name}: the parameterization is not injective ({faults}); give "
            "seam_vertices at the tips of long parts",
            kind="not_injective",
            key=name,
        )
    quality = {
        "flipped_triangles": float(flipped),
        "boundary_self_intersections": float(crossings),
        "median_symmetric_dirichlet": flat.distortion,
        "tutte_median_symmetric_dirichlet": flat.tutte_distortion,
        "seam_vertices": float(len(cut.seam_pairs)),
        "seconds": time.perf_counter() - start,
    }
    return {
        "name": name,
        "vertices": normalised,
        "faces": cut.faces,
        "uv": flat.uv,
        "domain": domain,
        "source_vertex": np.where(cut.origin >= 0, mesh.source_vertex[cut.origin], -1),
        "cut_vertex": _first_of_file(mesh, cut.origin),
        "seam_pairs": cut.seam_pairs,
        "scale": scale,
        "center": center,
        "quality": quality,
        "log": (*log, *cut.log, *flat.log),
        "given_uv": given,
    }


def closed_laid_out(
    mesh: CleanMesh,
    *,
    name: str,
    domain: Domain,
    parameterization: str,
    log: Sequence[str],
    cones: Sequence[int] | None = None,
) -> dict[str, Any]:
    """The fields of :meth:`nsm.Surface.from_closed`, which explains the arguments.

    Raises:
        NsmError: see :meth:`nsm.domains.orbifold.domain.ClosedDomain.embed`.
    """
    start = time.perf_counter()
    centred, center, scale = _centred(mesh.vertices, mesh.faces, domain)
    flat = domain.embed(centred * scale, mesh.faces, method=parameterization, name=name, keys=cones)
    origin, uv, faces = flat.copies()
    quality = {
        "flipped_triangles": float(flipped_triangles(uv, faces)),
        "median_symmetric_dirichlet": float(np.median(flat.distortions(centred))),
        "seconds": time.perf_counter() - start,
    }
    chosen: tuple[str, ...] = ()
    if flat.cones is not None:
        chosen = (f"cones at vertices {mesh.source_vertex[flat.cones].tolist()}",)
    return {
        "name": name,
        "vertices": (centred * scale)[origin],
        "faces": faces,
        "uv": uv,
        "domain": domain,
        "source_vertex": mesh.source_vertex[origin],
        "cut_vertex": _first_of_file(mesh, origin),
        "seam_pairs": seam_pairs(origin),
        "scale": scale,
        "center": center,
        "quality": quality,
        "log": (*log, *chosen),
        "lattice": flat.lattice * np.sqrt(domain.area / flat.area),
        "caps": mesh.caps,
    }


def _first_of_file(mesh: CleanMesh, origin: np.ndarray) -> np.ndarray:
    """For each vertex of the mesh file (W,) its first copy, -1 if it was removed.

    Args:
        mesh: the cleaned mesh.
        origin: (V,) its vertices that the surface's are copies of, -1 for inserted ones.
    """
    first = first_copies(origin, len(mesh.vertices))
    return np.where(mesh.merged >= 0, first[mesh.merged], -1)


def _centred(
    vertices: np.ndarray, faces: np.ndarray, domain: Domain
) -> tuple[np.ndarray, np.ndarray, float]:
    """Vertices (V, 3) about the middle of their bounding box, that middle (3,), and the scale by
    which the mesh gets the area of Ω."""
    center = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    centred = vertices - center
    area = float(topology.face_areas(centred, faces).sum())
    return centred, center, float(np.sqrt(domain.area / area))
