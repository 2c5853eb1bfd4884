"""Layouts over Ω that start from the texture coordinates of a mesh file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nsm.domains.base import BoundedDomain, Domain
from nsm.domains.embedding import Embedding
from nsm.domains.planar_mesh import boundary_self_intersections, flipped_triangles, signed_areas
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.cutting import Cut, disc_seam, seam_pairs, split_chords
from nsm.surfaces.geometry import triangle_distortion
from nsm.surfaces.seams import uv_seams
from nsm.surfaces.validation import CleanMesh
from nsm.wording import number_of

_KEY = "surface.parameterization"
_ON_BOUNDARY = 1e-5  # single precision of a file
# how far the sides of a cut are moved apart, of the way to the middle of the triangles around
_APART = (1e-3, 1e-5, 1e-7)


def check_given(
    uv: np.ndarray | None,
    faces: np.ndarray,
    domain: Domain,
    seam: Sequence[int] | None,
    name: str,
) -> np.ndarray:
    """Texture coordinates (F, 3, 2) of faces (F, 3), as a contiguous array.

    Raises:
        NsmError: ``missing_uv``: there are none for every corner; ``wrong_domain``: Ω has no
            boundary; ``conflicting_settings``: seam vertices.
    """
    what = f"{name}: {_KEY}=given"
    if not domain.has_boundary:
        message = f"{what} needs a domain with boundary; take domain=disc or domain=square"
        raise NsmError(message, kind="wrong_domain", key=_KEY)
    if seam is not None:
        message = f"{what} cuts along the texture coordinates; leave surface.seam_vertices out"
        raise NsmError(message, kind="conflicting_settings", key="surface.seam_vertices")
    if uv is None or np.shape(uv) != (len(faces), 3, 2) or not np.isfinite(uv).all():
        message = f"{what}: not every face has texture coordinates; unwrap it, or take slim"
        raise NsmError(message, kind="missing_uv", key=_KEY)
    return np.ascontiguousarray(uv, dtype=np.float64)


def cut_as_given(
    mesh: CleanMesh, faces: np.ndarray, uv: np.ndarray, name: str
) -> tuple[Cut, np.ndarray]:
    """As :func:`islands_as_given`, of texture coordinates that are one island.

    Raises:
        NsmError: ``unusable_uv``: several islands, or as there.
    """
    islands = islands_as_given(mesh, faces, uv, name)
    if len(islands) > 1:
        reason = f"have {len(islands)} islands; task=param flattens them one by one"
        raise _unusable(name, reason)
    return islands[0]


def islands_as_given(
    mesh: CleanMesh, faces: np.ndarray, uv: np.ndarray, name: str
) -> list[tuple[Cut, np.ndarray]]:
    """A mesh cut along the borders of its texture coordinates, those with most faces first.

    Args:
        mesh: the cleaned mesh.
        faces: (G, 3) of its file.
        uv: (G, 3, 2) texture coordinates at their corners.
        name: of the mesh, in messages.

    Returns:
        Discs, which have the vertices of their island alone, and the coordinates (V, 2) of their
        vertices, counter-clockwise: mirrored islands are turned over, those with holes cut open.

    Raises:
        NsmError: ``unusable_uv``: islands with flipped triangles or overlaps, or a face that the
            repair changed.
    """
    own = _at_corners(mesh, faces, uv, name)
    edges = topology.edges_of(mesh.faces)
    base = len(mesh.vertices)
    seams = np.sort(uv_seams(mesh.faces, own), axis=1) @ [base, 1]
    cut_faces, old = topology.cut_along(mesh.faces, np.isin(edges.pairs @ [base, 1], seams))
    flat = np.empty((len(old), 2))
    flat[cut_faces] = own
    log = f"cut along {number_of(len(np.unique(seams)), 'edge')}, as the texture coordinates are"
    label = topology.face_components(cut_faces)
    islands = []
    for k in np.argsort(-np.bincount(label), kind="stable").tolist():
        used, number = topology.renumbered(cut_faces[label == k], len(old))
        part, laid, origin = number[cut_faces[label == k]], flat[used], old[used]
        lines = [log]
        if signed_areas(laid, part).sum() < 0:
            laid = laid * [-1, 1]
            lines.append(
                "mirrored in the texture coordinates: turned over, to be seen from outside"
            )
        if not topology.is_disc(part):
            laid, part, inner, holes, cuts = _opened(laid, part, name)
            origin = origin[inner]
            lines.append(
                f"{number_of(holes, 'hole')} in the texture coordinates, cut open along "
                f"{number_of(cuts, 'edge')}"
            )
        _check(laid, part, name)
        both, part, inserted = split_chords(np.hstack([mesh.vertices[origin], laid]), part)
        origin = np.concatenate([origin, np.full(inserted, -1)])
        loop = topology.boundary_loops(part)[0]
        points = np.ascontiguousarray(both[:, :3])
        cut = Cut(points, part, origin, seam_pairs(origin), loop, tuple(lines))
        islands.append((cut, np.ascontiguousarray(both[:, 3:])))
    return islands


def _unusable(name: str, reason: str) -> NsmError:
    message = f"{name}: {_KEY}=given: the texture coordinates {reason}"
    return NsmError(message, kind="unusable_uv", key=_KEY)


def _at_corners(mesh: CleanMesh, faces: np.ndarray, uv: np.ndarray, name: str) -> np.ndarray:
    """Texture coordinates (F, 3, 2) at the corners of the cleaned mesh's faces."""
    merged = mesh.merged[faces]
    there = np.where(merged >= 0, mesh.source_vertex[merged], -1)
    here = mesh.source_vertex[mesh.faces]
    file_face, own_face = topology.equal_faces(there, here)
    if len(own_face) < len(here):
        lost = len(here) - len(own_face)
        raise _unusable(name, f"of {number_of(lost, 'face')} are lost by the repair; take slim")
    order = np.empty(len(here), dtype=np.int64)
    order[own_face] = file_face
    corner = (here[:, :, None] == there[order][:, None, :]).argmax(axis=2)
    return np.take_along_axis(uv[order], corner[:, :, None], axis=1)


def _check(flat: np.ndarray, faces: np.ndarray, name: str) -> None:
    """NsmError for coordinates (V, 2) of a disc that are not injective and counter-clockwise."""
    flipped = flipped_triangles(flat, faces)
    if flipped:
        reason = f"flip {flipped} of {len(faces)} triangles; mend them, or take slim"
        raise _unusable(name, reason)
    crossings = boundary_self_intersections(flat, topology.boundary_loops(faces)[0])
    if crossings:
        reason = f"overlap: their border crosses itself {number_of(crossings, 'time')}; take slim"
        raise _unusable(name, reason)


def _opened(
    flat: np.ndarray, faces: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, int]:
    """An island with holes, cut to a disc along short paths between its borders.

    The two sides of a cut are moved apart by a hair, so that the border does not touch itself.

    Args:
        flat: (V, 2) its coordinates, counter-clockwise.
        faces: (F, 3).
        name: of the mesh, in messages.

    Returns:
        Coordinates (W, 2) and faces (F, 3) of the disc; which vertex (W,) each is a copy of; the
        number of holes, and of edges cut.
    """
    seam, _ = disc_seam(np.pad(flat, ((0, 0), (0, 1))), faces, name=name)
    is_cut = np.zeros(len(topology.edges_of(faces).pairs), dtype=bool)
    is_cut[seam] = True
    disc, origin = topology.cut_along(faces, is_cut)
    if not topology.is_disc(disc):
        raise _unusable(name, "are no piece of the plane, but go around a handle; take slim")
    laid = flat[origin]
    middle = np.zeros_like(laid)
    np.add.at(middle, disc.ravel(), np.repeat(laid[disc].mean(axis=1), 3, axis=0))
    middle /= np.bincount(disc.ravel(), minlength=len(laid))[:, None]
    sides = np.unique(seam_pairs(origin))
    for share in _APART:
        moved = laid.copy()
        moved[sides] += share * (middle - laid)[sides]
        if flipped_triangles(moved, disc) <= flipped_triangles(laid, disc):
            break
    return moved, disc, origin, len(topology.boundary_loops(faces)) - 1, len(seam)


def in_units_of(domain: BoundedDomain, uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Coordinates (V, 2), counter-clockwise, scaled to the area of Ω and centred, not turned."""
    scale = np.sqrt(domain.area / signed_areas(uv, faces).sum())
    scaled: np.ndarray = (uv - uv.mean(axis=0)) * scale
    return scaled


def embedded_as_given(domain: BoundedDomain, cut: Cut, uv: np.ndarray, name: str) -> Embedding:
    """A disc laid out over Ω as it is laid out in the plane.

    Coordinates that fill Ω, but for their place and the two axes' units, are kept. Others are taken
    to Ω with least distortion, whatever the surface's own shape is.

    Args:
        domain: Ω.
        cut: the disc.
        uv: (V, 2) its coordinates, counter-clockwise and injective.
        name: of the mesh, in messages.

    Raises:
        NsmError: ``not_injective``.
    """
    import torch

    area = topology.face_areas(cut.vertices, cut.faces).sum()
    vertices = cut.vertices * np.sqrt(domain.area / area)
    low, high = uv.min(axis=0), uv.max(axis=0)
    filling = (2 * uv - low - high) / (high - low)
    off = domain.signed_distance(torch.as_tensor(filling[cut.loop])).abs().max()
    if float(off) < _ON_BOUNDARY:
        filling[cut.loop] = domain.boundary_points(domain.boundary_fractions(filling[cut.loop]))
        if (signed_areas(filling, cut.faces) > 0).all():
            median = float(np.median(triangle_distortion(filling, vertices, cut.faces)))
            line = "texture coordinates fill the domain: kept as they are"
            return Embedding(filling, median, float("nan"), (line,))
    plane = np.pad(in_units_of(domain, uv, cut.faces), ((0, 0), (0, 1)))
    flat = domain.embed(plane, cut.faces, name=name)
    u, _, vt = np.linalg.svd(plane[:, :2].T @ flat.uv)
    turn = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    turned = flat.uv @ domain.nearest_rotation(torch.as_tensor(turn)).numpy().T
    median = float(np.median(triangle_distortion(turned, vertices, cut.faces)))
    line = f"texture coordinates taken to the domain, median distortion {flat.distortion:.2f}"
    return Embedding(turned, median, float("nan"), (*flat.log, line))
