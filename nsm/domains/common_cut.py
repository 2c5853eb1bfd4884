"""Closed meshes cut along the same tree through their landmarks, and places of it on ∂Ω."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsm.domains.base import BoundedDomain, Keys
from nsm.domains.common_handles import with_handles_opened
from nsm.domains.common_seams import (
    SEAMS,
    aligned_keys,
    branch_keys,
    lead_tree,
    mutually_far,
    seam_costs,
    tracers_of,
)
from nsm.domains.disc import Disc
from nsm.errors import NsmError
from nsm.stages import at
from nsm.surfaces import topology
from nsm.surfaces.cutting import Cut, cut_along_paths
from nsm.surfaces.geometry import triangle_distortion
from nsm.surfaces.location import locate
from nsm.surfaces.validation import CleanMesh

# seam=auto tries seams through these shares of the landmarks
SHARES = (0.33, 0.45, 0.55, 0.67, 1.0)
_DISC = Disc()  # where seams are compared, whatever the domain
_WORST = 1e3  # upper bound on a triangle's distortion


@dataclass(frozen=True)
class CommonCut:
    """One way to cut all meshes: the discs, and the keys (K,) on each boundary."""

    seam: str
    count: int
    cuts: list[Cut]
    keys: list[np.ndarray]


def best_common_cut(
    names: Sequence[str],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    seam: str,
    seam_landmarks: int | None,
    others: Sequence[np.ndarray],
) -> CommonCut:
    """Closed meshes of one genus cut along corresponding seams.

    Args:
        names: of the meshes, in messages.
        cleaned: the meshes.
        landmarks: (L,) corresponding vertices of each.
        seam, seam_landmarks: as for :func:`nsm.domains.joint_preparation.prepare_jointly`.
        others: further vertices of each that no seam may touch.

    Raises:
        NsmError: ``no_common_seam``.
    """
    total = len(landmarks[0])
    costs = {
        path: [seam_costs(c.vertices, c.faces, path) for c in cleaned]
        for path in (SEAMS if seam == "auto" else (seam,))
    }
    if seam == "auto":
        counts = (
            [seam_landmarks]
            if seam_landmarks
            else sorted({max(2, round(share * total)) for share in SHARES})
        )
        ways = list(itertools.product(SEAMS, counts))
        tried = []
        for k, (path, count) in enumerate(ways):
            at("trying seams", k, len(ways))
            way = _common_cut(names, cleaned, landmarks, path, costs[path], count, others)
            if way is not None:
                tried.append((disagreement(way, landmarks), k, way))
        best = min(tried, default=(0.0, 0, None))[2]
    else:
        count = seam_landmarks or total
        best = _common_cut(names, cleaned, landmarks, seam, costs[seam], count, others)
    if best is None:
        raise NsmError(
            "no seams through the landmarks were found: some are too close together for the "
            "meshes' edges; leave one of them out, or subdivide the mesh",
            kind="no_common_seam",
            key="landmarks",
        )
    return best


def _common_cut(
    names: Sequence[str],
    cleaned: Sequence[CleanMesh],
    landmarks: Sequence[np.ndarray],
    seam: str,
    costs: Sequence[np.ndarray],
    count: int,
    others: Sequence[np.ndarray],
) -> CommonCut | None:
    """The meshes cut along one tree through ``count`` landmarks, whose branches are the cheapest
    by costs (E,) of each mesh's edges; None if there is no such tree."""
    pairs = [(c.vertices, c.faces) for c in cleaned]
    chosen = mutually_far(pairs, landmarks, count)
    on_seam = [ids[chosen] for ids in landmarks]
    avoid = [np.concatenate([ids, more]) for ids, more in zip(landmarks, others, strict=True)]
    tree = tracers_of(pairs, on_seam, costs, avoid)
    tracers = with_handles_opened(tree) if lead_tree(tree) else None
    if tracers is None:
        return None
    cuts = [
        cut_along_paths(c.vertices, c.faces, t.laid, name=name)
        for c, t, name in zip(cleaned, tracers, names, strict=True)
    ]
    keys = aligned_keys([branch_keys(c, t.laid) for c, t in zip(cuts, tracers, strict=True)])
    assert keys is not None, "branches in the same cyclic order make equal walks"
    return CommonCut(seam, len(chosen), cuts, [k[:, 1] for k in keys])


def disagreement(way: CommonCut, landmarks: Sequence[np.ndarray]) -> float:
    """How badly the domains agree: the distortion of the identity between two domains, times how
    far it misses the landmarks off the seam.

    The worst ordered pair counts. Landmarks on the wrong side of a seam lie far apart in Ω, and no
    map without folds brings them together; hence the factor. Infinite where a disc cannot be laid
    out without flips.
    """
    fractions = np.mean(
        [_arc_lengths(cut, key) for cut, key in zip(way.cuts, way.keys, strict=True)], axis=0
    )
    try:
        flat = [
            _DISC.embed(cut.vertices, cut.faces, method="slim_held", keys=Keys(key, fractions)).uv
            for cut, key in zip(_of_disc_area(way.cuts), way.keys, strict=True)
        ]
    except NsmError:
        return np.inf
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
    for k, (cut, key) in enumerate(zip(_of_disc_area(cuts), keys, strict=True)):
        at("places on the boundary", k, len(cuts))
        uv = _DISC.embed(cut.vertices, cut.faces, keys=Keys(key[:1], np.zeros(1))).uv[key]
        angle = np.arctan2(uv[:, 1], uv[:, 0]) / (2 * np.pi)
        gaps.append((np.roll(angle, -1) - angle) % 1.0)
    mean = np.mean(gaps, axis=0)
    fractions = np.concatenate([[0.0], np.cumsum(mean / mean.sum())[:-1]])
    return domain.through_corners(fractions)
