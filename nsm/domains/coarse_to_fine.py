"""Coarse-to-fine layout of large meshes: embed a decimated mesh, then reinsert the vertices.

Each round of :mod:`nsm.domains.decimation` is undone in the plane without flips. Reinserted
vertices, and from time to time all vertices, are relaxed. Time and memory grow linearly with the
mesh, not with the fill of a factorised matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.decimation import Round, coarsen, present_faces, undo
from nsm.domains.vertex_relaxation import Freedom, Stars, relax, sweep
from nsm.stages import at
from nsm.surfaces import topology

if TYPE_CHECKING:
    from nsm.domains.base import BoundedDomain

_GROWTH = 2.0  # of the faces between two sweeps over all vertices
_SWEEPS = 8
_STEPS = 3  # of Newton's method on reinserted vertices
_NEARER = 0.7  # factor on the distance to the target, each time a vertex does not fit
_TRIES = 40


def embed_coarse_to_fine(
    vertices: np.ndarray,
    faces: np.ndarray,
    loop: np.ndarray,
    boundary: np.ndarray,
    domain: BoundedDomain,
    held: np.ndarray,
    solve: Callable[..., np.ndarray],
    count: int,
) -> np.ndarray | None:
    """Coordinates (V, 2) of a disc-shaped mesh (V, 3), (F, 3) that has the domain's area.

    Args:
        loop, boundary: the boundary loop's vertices (B,), and their initial places (B, 2).
        domain: Ω.
        held: (V,) mask of boundary vertices that stay in their initial places.
        solve: lays out the coarse mesh without flips: from its vertices, faces, loop, boundary and
            held to its coordinates.
        count: faces of the coarse mesh.

    Returns:
        None if rounding leaves a vertex no place without a flip.
    """
    current, rounds = coarsen(vertices, faces, held, count)
    coarse = present_faces(current)
    ids, local = topology.renumbered(coarse, len(vertices))
    left = np.isin(loop, ids)
    area = topology.face_areas(vertices, faces).sum() / topology.face_areas(vertices, coarse).sum()
    uv = np.zeros((len(vertices), 2))
    points, coarse_loop = vertices[ids] * np.sqrt(area), local[loop[left]]
    uv[ids] = solve(points, local[coarse], coarse_loop, boundary[left], held[ids])
    on_boundary = np.zeros(len(vertices), dtype=bool)
    on_boundary[loop] = True
    freedom = Freedom(on_boundary, held, domain)
    swept = len(coarse)
    for step in reversed(rounds):
        undo(current, step)
        if not _reinsert(vertices, current, uv, freedom, step):
            return None
        present = present_faces(current)
        at("faces laid out", len(present), len(faces))
        if len(present) >= _GROWTH * swept or step is rounds[0]:
            swept = len(present)
            sweep(vertices, present, uv, freedom, _SWEEPS)
    return uv


def _reinsert(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, freedom: Freedom, step: Round
) -> bool:
    """Place a round's vertices in uv (V, 2) without flips; whether all found a place."""
    face, k = step.corners // 3, step.corners % 3
    b, c = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
    stars = Stars.of(vertices, step.vertex, step.star, b, c)
    inner = step.before < 0
    place = np.empty((len(step.vertex), 2))
    place[inner] = _mean_values(vertices, uv, stars)[inner]
    place[~inner] = _between(vertices, uv, step, ~inner)
    fits = _placed(uv, stars, step, place, freedom)
    # near the target there is always room, though not in every direction
    left, step_left = stars.subset(~fits), step.subset(~fits)
    if (
        len(left.vertex)
        and not _placed(
            uv, left, step_left, _inwards(uv, left, step_left, place[~fits]), freedom
        ).all()
    ):
        return False
    for _ in range(_STEPS):
        relax(uv, stars, freedom)
    return True


def _placed(
    uv: np.ndarray, stars: Stars, step: Round, place: np.ndarray, freedom: Freedom
) -> np.ndarray:
    """Move each star's vertex to its place (N, 2), or from there towards its target until nothing
    flips; mask (N,) of the vertices that found a place."""
    found = np.zeros(len(place), dtype=bool)
    missing, share = np.arange(len(place)), 1.0
    for _ in range(_TRIES):
        if len(missing) == 0:
            break
        target, on_boundary = uv[step.target[missing]], step.before[missing] >= 0
        trial = target + share * (place[missing] - target)
        trial = _retracted(trial, target, place[missing], on_boundary, freedom)
        fits = np.isfinite(stars.energy(uv, trial))
        uv[stars.vertex[fits]] = trial[fits]
        found[missing[fits]] = True
        stars, missing = stars.subset(~fits), missing[~fits]
        share *= _NEARER
    return found


def _inwards(uv: np.ndarray, stars: Stars, step: Round, place: np.ndarray) -> np.ndarray:
    """Places (N, 2) as far from their targets as the given ones, but between the star's sides.

    Boundary vertices keep the given ones.
    """
    target = step.target[stars.star]
    left = np.zeros((len(place), 2))
    for which in (stars.b == target, stars.c == target):
        side = uv[stars.c[which]] - uv[stars.b[which]]
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        left[stars.star[which]] += np.stack([-side[:, 1], side[:, 0]], axis=1)
    at = uv[step.target]
    distance = np.linalg.norm(place - at, axis=1) / np.linalg.norm(left, axis=1).clip(1e-300)
    return np.where(step.before[:, None] < 0, at + distance[:, None] * left, place)


def mean_value_weights(
    vertices: np.ndarray, middle: np.ndarray, ring: np.ndarray, d: np.ndarray
) -> np.ndarray:
    """Mean value weights (2, M) of both ends of each triangle's side in the mean of a ring (Floater
    2003); they do not add up to one.

    Args:
        vertices: (V, 3).
        middle: (M,) vertex within the ring.
        ring: (2, M) the triangle's other vertices.
        d: (M,) one over twice its area.
    """
    p = vertices[middle]
    to_b, to_c = vertices[ring[0]] - p, vertices[ring[1]] - p
    lb, lc = (np.maximum(np.sqrt((e * e).sum(axis=1)), 1e-12) for e in (to_b, to_c))
    # tan of half the angle at p
    half = (1 / d) / (lb * lc + (to_b * to_c).sum(axis=1)).clip(1e-300)
    return half.clip(1e-6, 1e6) / np.stack([lb, lc])


def _mean_values(vertices: np.ndarray, uv: np.ndarray, stars: Stars) -> np.ndarray:
    """The mean (N, 2) of each star's ring with mean value weights."""
    weights = mean_value_weights(
        vertices, stars.vertex[stars.star], np.stack([stars.b, stars.c]), stars.d
    )
    b, c = weights[:, :, None] * [uv[stars.b], uv[stars.c]]
    parts = np.concatenate([b + c, weights.sum(axis=0)[:, None]], axis=1)
    n = len(stars.vertex)
    x, y, weight = (np.bincount(stars.star, weights=part, minlength=n) for part in parts.T)
    return np.stack([x / weight, y / weight], axis=1)


def _between(vertices: np.ndarray, uv: np.ndarray, step: Round, which: np.ndarray) -> np.ndarray:
    """Places (K, 2) on ∂Ω between two neighbours, at the shares of length that the mesh has."""
    v, w, a = step.vertex[which], step.target[which], step.before[which]
    after = np.linalg.norm(vertices[v] - vertices[w], axis=1)
    before = np.linalg.norm(vertices[v] - vertices[a], axis=1)
    share = (after / (before + after))[:, None]
    return uv[w] + share * (uv[a] - uv[w])


def _retracted(
    trial: np.ndarray, one: np.ndarray, other: np.ndarray, on_boundary: np.ndarray, freedom: Freedom
) -> np.ndarray:
    """Points of chords (N, 2), those of a mask moved to ∂Ω along the sides they are on."""
    same = on_boundary[:, None] & (one == other)
    return freedom.retract(np.where(same, one, trial), on_boundary)
