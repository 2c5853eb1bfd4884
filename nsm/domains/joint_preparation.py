"""Joint preparation of several meshes, so that their domains correspond."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsm.domains.base import BoundedDomain, Domain, Keys
from nsm.domains.common_seams import (
    SEAMS,
    aligned_keys,
    boundary_keys,
    corresponding_paths,
    mutually_far,
    seam_costs,
)
from nsm.domains.disc import Disc
from nsm.domains.names import bounded
from nsm.domains.names import domain as domain_of
from nsm.domains.names import stored as stored_domain
from nsm.domains.orbifold.common_cones import choose_common_cones, distinct
from nsm.domains.surface import Surface
from nsm.errors import NsmError
from nsm.surfaces import cache as cache_
from nsm.surfaces import topology
from nsm.surfaces.cutting import Cut, cut_along_paths
from nsm.surfaces.geometry import triangle_distortion
from nsm.surfaces.location import locate
from nsm.surfaces.validation import CleanMesh, clean

# seam=auto tries seams through these shares of the landmarks
_SHARES = (0.33, 0.45, 0.55, 0.67, 1.0)
_DISC = Disc()  # where seams are compared, whatever the domain
_WORST = 1e3  # upper bound on a triangle's distortion


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
) -> list[Surface]:
    """Prepare meshes so that corresponding landmarks have corresponding places in Ω.

    For a domain with boundary, closed genus-0 meshes with two landmarks or more are cut along
    corresponding seams, and the landmarks on the seam get the same places on ∂Ω in all of them. On
    the orbifold, meshes with four landmarks or more get the same four as their cones, those whose
    domains are least distorted in the mean. Other meshes are prepared one by one.

    Args:
        meshes: two or more.
        landmarks: (L,) vertices of each, in the same order.
        domain, parameterization, cache: as for :meth:`Surface.load`.
        seam: ``shortest`` paths, or ``hidden`` ones, which prefer regions seen from few sides; or
            ``auto``, which tries both and keeps the seam for which the domains agree best.
        seam_landmarks: how many landmarks, mutually far ones, the seam passes through; by default
            all of them, or, with ``auto``, the number for which the domains agree best.

    Raises:
        NsmError: a mesh that cannot be prepared; ``wrong_topology`` if genus or number of boundary
            loops differ; ``no_common_seam``.
    """
    domain = domain_of(domain)
    cleaned = [clean(m.vertices, m.faces, m.name) for m in meshes]
    found = [_kept(c, ids, m.name) for c, ids, m in zip(cleaned, landmarks, meshes, strict=True)]
    enough = len(found[0]) >= 2 if domain.has_boundary else len(distinct(found)) >= 4
    if _common_topology(meshes, cleaned) != (0, 0) or not enough:
        return [
            Surface.from_arrays(
                m.vertices,
                m.faces,
                name=m.name,
                domain=domain,
                parameterization=parameterization,
                cache=cache,
                log=m.log,
            )
            for m in meshes
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
    }
    # keys of the files: meshes that are equal once cleaned may still differ in vertex numbers
    names = [cache_.preparation_key(m.vertices, m.faces, options) for m in meshes]
    if cache:
        stored = [cache_.read(key) for key in names]
        if all(s is not None for s in stored):
            return [
                Surface.from_stored(m.name, domain, s)
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
    return surfaces


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


def _common_topology(meshes: Sequence[Mesh], cleaned: Sequence[CleanMesh]) -> tuple[int, int]:
    """Genus and number of boundary loops of all meshes.

    Raises:
        NsmError: ``wrong_topology``: they differ; a map would be torn.
    """
    found = []
    for clean_mesh in cleaned:
        loops = len(topology.boundary_loops(clean_mesh.faces))
        found.append(((2 - topology.euler_characteristic(clean_mesh.faces) - loops) // 2, loops))
    for mesh, (genus, loops) in zip(meshes, found, strict=True):
        if (genus, loops) != found[0]:
            raise NsmError(
                f"{mesh.name} has genus {genus} and {loops} boundary loops, {meshes[0].name} genus "
                f"{found[0][0]} and {found[0][1]}: a map between them would tear; fill holes or "
                "remove handles until they agree",
                kind="wrong_topology",
                key=mesh.name,
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


@dataclass(frozen=True)
class _CommonCut:
    """One way to cut all meshes: the discs, and the keys (K,) on each boundary."""

    seam: str
    count: int
    cuts: list[Cut]
    keys: list[np.ndarray]


def _cut_and_embed(
    meshes: Sequence[Mesh],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    domain: Domain,
    method: str,
    seam: str,
    seam_landmarks: int | None,
) -> list[Surface]:
    total = len(landmarks[0])
    costs = {
        path: [seam_costs(c.vertices, c.faces, path) for c in cleaned]
        for path in (SEAMS if seam == "auto" else (seam,))
    }
    if seam == "auto":
        counts = (
            [seam_landmarks]
            if seam_landmarks
            else sorted({max(2, round(share * total)) for share in _SHARES})
        )
        tried = [
            (_disagreement(way, landmarks), k, way)
            for k, (path, count) in enumerate(itertools.product(SEAMS, counts))
            if (way := _common_cut(meshes, cleaned, landmarks, path, costs[path], count))
            is not None
        ]
        best = min(tried, default=(0.0, 0, None))[2]
    else:
        best = _common_cut(meshes, cleaned, landmarks, seam, costs[seam], seam_landmarks or total)
    if best is None:
        raise NsmError(
            "no seams through the landmarks were found: some are too close together for the "
            "meshes' edges; leave one of them out, or subdivide the mesh",
            kind="no_common_seam",
            key="landmarks",
        )
    fractions = common_fractions(best.cuts, best.keys, bounded(domain))
    line = (
        f"seam led along {best.seam} paths through {best.count} of {total} landmarks, the same "
        "on all meshes"
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
        for m, c, cut, key in zip(meshes, cleaned, best.cuts, best.keys, strict=True)
    ]


def _common_cut(
    meshes: Sequence[Mesh],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    seam: str,
    costs: Sequence[np.ndarray],
    count: int,
) -> _CommonCut | None:
    """The meshes cut along one tree through ``count`` landmarks, whose branches are the cheapest
    by costs (E,) of each mesh's edges; None if there is no such tree."""
    pairs = [(c.vertices, c.faces) for c in cleaned]
    chosen = mutually_far(pairs, landmarks, count)
    on_seam = [ids[chosen] for ids in landmarks]
    paths = corresponding_paths(pairs, on_seam, costs, avoid=landmarks)
    if paths is None:
        return None
    cuts = [
        cut_along_paths(c.vertices, c.faces, p, name=m.name)
        for c, p, m in zip(cleaned, paths, meshes, strict=True)
    ]
    keys = aligned_keys(
        [boundary_keys(cut.origin, cut.loop, ids) for cut, ids in zip(cuts, on_seam, strict=True)]
    )
    assert keys is not None, "branches in the same cyclic order make equal walks"
    return _CommonCut(seam, len(chosen), cuts, [k[:, 1] for k in keys])


def _disagreement(way: _CommonCut, landmarks: Sequence[np.ndarray]) -> float:
    """How badly the domains agree: the distortion of the identity between two domains, times how
    far it misses the landmarks off the seam.

    The worst ordered pair counts. Landmarks on the wrong side of a seam lie far apart in Ω, and no
    map without folds brings them together; hence the factor.
    """
    fractions = np.mean(
        [_arc_lengths(cut, key) for cut, key in zip(way.cuts, way.keys, strict=True)], axis=0
    )
    flat = [
        _DISC.embed(cut.vertices, cut.faces, method="slim_held", keys=Keys(key, fractions)).uv
        for cut, key in zip(_of_disc_area(way.cuts), way.keys, strict=True)
    ]
    places = []
    for cut, uv, ids in zip(way.cuts, flat, landmarks, strict=True):
        off = [int(np.flatnonzero(cut.origin == v)[0]) for v in ids]
        inner = [v for v in off if v not in set(cut.loop.tolist())]
        places.append(uv[inner])
    worst = 0.0
    discs = _of_disc_area(way.cuts)
    for i, j in itertools.permutations(range(len(discs)), 2):
        image = locate(flat[i], flat[j], discs[j].faces).take(discs[j].vertices, discs[j].faces)
        value = triangle_distortion(discs[i].vertices, image, discs[i].faces)
        area = topology.face_areas(discs[i].vertices, discs[i].faces)
        mean = float(np.average(np.minimum(value, _WORST), weights=area))
        miss = np.linalg.norm(places[i] - places[j], axis=1).max(initial=0.0)
        worst = max(worst, mean * (1 + float(miss)))
    return worst


def _of_disc_area(cuts: Sequence[Cut]) -> list[Cut]:
    """The discs scaled to the area of Ω."""
    scales = [np.sqrt(_DISC.area / topology.face_areas(c.vertices, c.faces).sum()) for c in cuts]
    return [replace(c, vertices=c.vertices * s) for c, s in zip(cuts, scales, strict=True)]


def _arc_lengths(cut: Cut, keys: np.ndarray) -> np.ndarray:
    """Fractions (K,) of the boundary's length at which its keys lie, the first at 0."""
    loop = np.roll(cut.loop, -int(np.flatnonzero(cut.loop == keys[0])[0]))
    points = cut.vertices[loop]
    lengths = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)[:-1]]) / lengths.sum()
    place = {int(v): k for k, v in enumerate(loop)}
    return along[[place[int(v)] for v in keys]]


def common_fractions(
    cuts: Sequence[Cut], keys: Sequence[np.ndarray], domain: BoundedDomain
) -> np.ndarray:
    """Places (K,) on ∂Ω, as fractions of the way around, that suit the keys of all discs.

    Each disc is flattened with its boundary free to slide; the gaps between its keys are averaged
    over the discs. The keys nearest to the domain's corners become the corners.
    """
    gaps = []
    for cut, key in zip(_of_disc_area(cuts), keys, strict=True):
        uv = _DISC.embed(cut.vertices, cut.faces, keys=Keys(key[:1], np.zeros(1))).uv[key]
        angle = np.arctan2(uv[:, 1], uv[:, 0]) / (2 * np.pi)
        gaps.append((np.roll(angle, -1) - angle) % 1.0)
    mean = np.mean(gaps, axis=0)
    fractions = np.concatenate([[0.0], np.cumsum(mean / mean.sum())[:-1]])
    return domain.through_corners(fractions)


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
