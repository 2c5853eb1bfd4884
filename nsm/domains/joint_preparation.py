"""Joint preparation of several meshes, so that their domains correspond."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from nsm.domains.base import BoundedDomain, Domain, Keys
from nsm.domains.common_cut import best_common_cut, common_fractions
from nsm.domains.common_seams import aligned_keys, boundary_keys
from nsm.domains.names import bounded
from nsm.domains.names import domain as domain_of
from nsm.domains.names import stored as stored_domain
from nsm.domains.orbifold.common_cones import choose_common_cones, distinct
from nsm.domains.surface import Surface
from nsm.errors import NsmError
from nsm.stages import counted
from nsm.surfaces import cache as cache_
from nsm.surfaces import topology
from nsm.surfaces.validation import NO_DECISION, CleanMesh, Repairs, clean


@dataclass(frozen=True)
class Mesh:
    """A mesh as read: name, vertices (V, 3), faces (F, 3), and the log of reading it."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    log: tuple[str, ...] = ()


def prepare_jointly(
    meshes: Sequence[Mesh],
    landmarks: Sequence[np.ndarray],
    *,
    domain: str | Domain = "disc",
    parameterization: str = "slim",
    seam: str = "auto",
    seam_landmarks: int | None = None,
    cache: bool = True,
    repairs: Repairs = NO_DECISION,
) -> list[Surface]:
    """Prepare meshes so that corresponding landmarks have corresponding places in Ω.

    For a domain with boundary, closed genus-0 meshes with two landmarks or more are cut along
    corresponding seams, and the landmarks on the seam get the same places on ∂Ω in all of them. On
    the orbifold, meshes with four landmarks or more get the same four as their cones, those whose
    domains are least distorted in the mean. Other meshes are prepared one by one.

    Args:
        meshes: two or more.
        landmarks: (L,) vertices of each, in the same order.
        domain, parameterization, cache, repairs: as for :meth:`Surface.load`.
        seam: ``shortest`` paths, or ``hidden`` ones, which prefer regions seen from few sides; or
            ``auto``, which tries both and keeps the seam for which the domains agree best; or
            ``own``: each mesh is cut by itself.
        seam_landmarks: how many landmarks, mutually far ones, the seam passes through; by default
            all of them, or, with ``auto``, the number for which the domains agree best.

    Raises:
        NsmError: a mesh that cannot be prepared; ``wrong_topology`` if genus or number of boundary
            loops differ; ``no_common_seam``.
    """
    domain = domain_of(domain)
    cleaned = [clean(m.vertices, m.faces, m.name, repairs) for m in meshes]
    found = [_kept(c, ids, m.name) for c, ids, m in zip(cleaned, landmarks, meshes, strict=True)]
    enough = len(found[0]) >= 2 if domain.has_boundary else len(distinct(found)) >= 4
    apart = seam == "own" and domain.has_boundary
    kinds = [topology.genus_and_boundary(c.faces) for c in cleaned]
    common = check_common_topology([m.name for m in meshes], kinds)
    if common != (0, 0) or not enough or apart:
        return [
            Surface.from_arrays(
                m.vertices,
                m.faces,
                name=m.name,
                domain=domain,
                parameterization=parameterization,
                cache=cache,
                log=m.log,
                repairs=repairs,
            )
            for m in counted("layout on the domain", meshes)
        ]
    digest = hashlib.sha256()
    for c, ids in zip(cleaned, found, strict=True):
        for array in (c.vertices, c.faces, ids):
            digest.update(np.ascontiguousarray(array).tobytes())
    options = {
        "together": digest.hexdigest(),
        "domain": stored_domain(domain),
        "method": parameterization,
        "seam": [seam, seam_landmarks],
        "repairs": asdict(repairs),
    }
    # keys of the files: meshes that are equal once cleaned may still differ in vertex numbers
    names = [cache_.preparation_key(m.vertices, m.faces, options) for m in meshes]
    if cache:
        stored = [cache_.read(key) for key in names]
        if all(s is not None for s in stored):
            return [
                replace(Surface.from_stored(m.name, domain, s), raw=(m.vertices, m.faces))
                for m, s in zip(meshes, stored, strict=True)
                if s is not None
            ]
    if domain.has_boundary:
        surfaces = _cut_and_embed(
            meshes, cleaned, found, domain, parameterization, seam, seam_landmarks
        )
    else:
        surfaces = _with_common_cones(meshes, cleaned, found, domain, parameterization)
    if cache:
        for key, surface in zip(names, surfaces, strict=True):
            cache_.write(key, surface.to_stored())
    return [
        replace(surface, raw=(m.vertices, m.faces))
        for m, surface in zip(meshes, surfaces, strict=True)
    ]


def _with_common_cones(
    meshes: Sequence[Mesh],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    domain: Domain,
    method: str,
) -> list[Surface]:
    numbers, score = choose_common_cones([(c.vertices, c.faces) for c in cleaned], landmarks)
    line = (
        f"cones at landmarks {numbers.tolist()}, counted from 0, the same on all meshes: mean log "
        f"distortion {score:.3f}"
    )
    return [
        Surface.from_closed(
            c,
            name=m.name,
            domain=domain,
            parameterization=method,
            cones=ids[numbers].tolist(),
            log=(*m.log, *c.log, line),
        )
        for m, c, ids in zip(meshes, cleaned, landmarks, strict=True)
    ]


def check_common_topology(
    names: Sequence[str], found: Sequence[tuple[int, int]]
) -> tuple[int, int]:
    """Genus and number of boundary loops of all surfaces.

    Raises:
        NsmError: ``wrong_topology``: they differ; a map would be torn.
    """
    for name, (genus, loops) in zip(names, found, strict=True):
        if (genus, loops) != found[0]:
            if genus == found[0][0] and 0 in (loops, found[0][1]):
                open_, closed = (name, names[0]) if loops else (names[0], name)
                raise NsmError(
                    f"{open_} has a boundary and {closed} has none: maps take whole surfaces to "
                    f"whole ones, not a part into a whole; close the holes of {open_}, or cut from "
                    f"{closed} the part that corresponds",
                    kind="wrong_topology",
                    key=name,
                )
            raise NsmError(
                f"{name} has genus {genus} and {loops} boundary loops, {names[0]} genus "
                f"{found[0][0]} and {found[0][1]}: a map between them would tear; fill holes or "
                "remove handles until they agree",
                kind="wrong_topology",
                key=name,
            )
    return found[0]


def _kept(mesh: CleanMesh, landmarks: np.ndarray, name: str) -> np.ndarray:
    """Landmarks as vertices of the cleaned mesh."""
    kept = mesh.merged[landmarks]
    for given, vertex in zip(landmarks, kept, strict=True):
        if vertex < 0:
            raise NsmError(
                f"{name}: landmark {given} is not on the surface; give another vertex",
                kind="not_on_surface",
                key=name,
            )
    return kept


def _cut_and_embed(
    meshes: Sequence[Mesh],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    domain: Domain,
    method: str,
    seam: str,
    seam_landmarks: int | None,
) -> list[Surface]:
    names = [m.name for m in meshes]
    best = best_common_cut(names, cleaned, landmarks, seam, seam_landmarks)
    fractions = common_fractions(best.cuts, best.keys, bounded(domain))
    line = (
        f"seam led along {best.seam} paths through {best.count} of {len(landmarks[0])} landmarks, "
        "the same on all meshes"
    )
    return [
        Surface.from_cut(
            cut,
            c,
            name=m.name,
            domain=domain,
            parameterization=method,
            keys=Keys(key, fractions),
            log=(*m.log, *c.log, line),
        )
        for m, c, cut, key in counted(
            "layout on the domain",
            list(zip(meshes, cleaned, best.cuts, best.keys, strict=True)),
        )
    ]


@dataclass(frozen=True)
class Matched:
    """Landmarks found in the domains of several surfaces.

    points: (K, 2) in Ω, one array per surface; numbers: (K,) which landmark each is. The first
    ``on_boundary`` lie on ∂Ω, in the order in which it is walked counter-clockwise; a landmark on
    the seam is there once for each time that the walk passes it.
    """

    points: list[np.ndarray]
    numbers: np.ndarray
    on_boundary: int

    def seam(self, domain: BoundedDomain, count: int) -> np.ndarray:
        """(T, 2, 2) pairs of points of ∂Ω that are one point of each surface with this seam.

        The walk around ∂Ω passes each branch of the seam twice, out and back. ``count`` points on
        the way out are paired with those on the way back at the same shares of the length. Nothing
        is paired where the walk is not around a tree.
        """
        numbers = self.numbers[: self.on_boundary].tolist()
        t = domain.boundary_fractions(self.points[0][: self.on_boundary])
        ways = {
            (numbers[k], numbers[(k + 1) % len(numbers)]): (
                t[k],
                (t[(k + 1) % len(numbers)] - t[k]) % 1.0 or 1.0,
            )
            for k in range(len(numbers))
        }
        share = (np.arange(count) + 0.5) / count
        pairs = []
        for (a, b), (begin, span) in ways.items():
            if a < b and (b, a) in ways:
                back, width = ways[b, a]
                both = (begin + span * share, back + width * (1 - share))
                pairs.append(np.stack([domain.boundary_points(w % 1.0) for w in both], axis=1))
        return np.concatenate(pairs) if pairs else np.zeros((0, 2, 2))


def matched_landmarks(surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray]) -> Matched:
    """Corresponding points in the domains of surfaces.

    A landmark on the seam has several preimages on ∂Ω; they correspond in the order in which the
    boundary passes them. On a closed domain each has one, in one of its lifts.

    Args:
        surfaces: all of one domain.
        landmarks: vertices (L,) of each one's mesh file.

    Raises:
        NsmError: a landmark that a surface does not have, or boundaries that do not correspond.
    """
    if not surfaces[0].domain.has_boundary:
        points = [s.preimages(ids.tolist()) for s, ids in zip(surfaces, landmarks, strict=True)]
        return Matched(points, np.arange(len(landmarks[0])), 0)
    keys = [
        boundary_keys(s.source_vertex, topology.boundary_loops(s.faces)[0], s.kept(ids.tolist()))
        for s, ids in zip(surfaces, landmarks, strict=True)
    ]
    aligned = aligned_keys(keys)
    if aligned is None:
        names = " and ".join(s.name for s in surfaces)
        raise NsmError(
            f"the boundaries of {names}, once cut, pass the landmarks differently; give meshes "
            "instead of ready surfaces, so that their seams correspond, or other landmarks",
            kind="no_common_seam",
            key="landmarks",
        )
    inner = np.setdiff1d(np.arange(len(landmarks[0])), keys[0][:, 0])
    points = [
        np.concatenate([s.uv[key[:, 1]], s.preimages(ids[inner].tolist())])
        for s, key, ids in zip(surfaces, aligned, landmarks, strict=True)
    ]
    return Matched(points, np.concatenate([aligned[0][:, 0], inner]), len(aligned[0]))
