"""Large meshes laid out coarse first: the coarse mesh is solved for, the rest is put back in.

Each round of :mod:`nsm.domains.decimation` is undone in the plane without a flip, and what was
put back, and from time to time everything, is relaxed. Time and memory grow with the mesh alone,
not with the fill of a factorised matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.decimation import Round, coarsen, present_faces, undo
from nsm.domains.vertex_relaxation import Freedom, Stars, relax, sweep
from nsm.surfaces import topology

if TYPE_CHECKING:
    from nsm.domains.base import BoundedDomain

_GROWTH = 2.0  # of the faces between two sweeps over all vertices
_SWEEPS = 8
_STEPS = 3  # of Newton's method on what was put back
_NEARER = 0.7  # how far a vertex that does not fit goes towards its target, each time
_TRIES = 40


def laid_out(
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
        loop, boundary: the boundary's vertices (B,), and where the coarse mesh's start (B, 2).
        domain: Ω.
        held: (V,) mask of boundary vertices that stay where ``boundary`` has them.
        solve: lays out the coarse mesh, without flips; from what is given here of it, the domain
            aside, to its coordinates.
        count: faces of the coarse mesh.

    Returns:
        None if a vertex finds no place without a flip, for lack of digits.
    """
    current, rounds = coarsen(vertices, faces, held, count)
    coarse = present_faces(current)
    ids, local = topology.renumbered(coarse, len(vertices))
    left = np.isin(loop, ids)
    area = topology.face_areas(vertices, faces).sum() / topology.face_areas(vertices, coarse).sum()
    uv = np.zeros((len(vertices), 2))
    points, rim_left = vertices[ids] * np.sqrt(area), local[loop[left]]
    uv[ids] = solve(points, local[coarse], rim_left, boundary[left], held[ids])
    rim = np.zeros(len(vertices), dtype=bool)
    rim[loop] = True
    freedom = Freedom(rim, held, domain)
    swept = len(coarse)
    for step in reversed(rounds):
        undo(current, step)
        if not _put_back(vertices, current, uv, freedom, step):
            return None
        present = present_faces(current)
        if len(present) >= _GROWTH * swept or step is rounds[0]:
            swept = len(present)
            sweep(vertices, present, uv, freedom, _SWEEPS)
    return uv


def _put_back(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, freedom: Freedom, step: Round
) -> bool:
    """Give a round's vertices places in uv (V, 2) that flip no triangle; whether that was done."""
    face, k = step.corners // 3, step.corners % 3
    b, c = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
    stars = Stars.of(vertices, step.vertex, step.star, b, c)
    inner = step.before < 0
    place = np.empty((len(step.vertex), 2))
    place[inner] = _mean_values(vertices, uv, stars)[inner]
    place[~inner] = _between(vertices, uv, freedom, step, ~inner)
    fits = _placed(uv, stars, step, place, freedom)
    # near the target there is always room, but not in every direction
    left, step_left = stars.chosen(~fits), step.chosen(~fits)
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
    """Move each star's vertex to its place (N, 2), or as near to it from its target as it flips
    nothing; mask (N,) of those that found a place."""
    found = np.zeros(len(place), dtype=bool)
    missing, share = np.arange(len(place)), 1.0
    for _ in range(_TRIES):
        if len(missing) == 0:
            break
        target, rim = uv[step.target[missing]], step.before[missing] >= 0
        trial = target + share * (place[missing] - target)
        trial = _on_rim(trial, target, place[missing], rim, freedom)
        fits = np.isfinite(stars.energy(uv, trial))
        uv[stars.vertex[fits]] = trial[fits]
        found[missing[fits]] = True
        stars, missing = stars.chosen(~fits), missing[~fits]
        share *= _NEARER
    return found


def _inwards(uv: np.ndarray, stars: Stars, step: Round, place: np.ndarray) -> np.ndarray:
    """Places (N, 2) as far from their targets as the given ones, but between the sides there.

    Of a vertex on the boundary, the given ones.
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


def _mean_values(vertices: np.ndarray, uv: np.ndarray, stars: Stars) -> np.ndarray:
    """The mean (N, 2) of each star's ring with mean value weights (Floater 2003)."""
    p = vertices[stars.vertex[stars.star]]
    to_b, to_c = vertices[stars.b] - p, vertices[stars.c] - p
    lb, lc = np.linalg.norm(to_b, axis=1), np.linalg.norm(to_c, axis=1)
    # tan of half the angle at p; 1 / d is twice the area
    half = (1 / stars.d) / (lb * lc + (to_b * to_c).sum(axis=1)).clip(1e-300)
    half = half.clip(1e-6, 1e6)
    n = len(stars.vertex)

    def total(of_b: np.ndarray, of_c: np.ndarray) -> np.ndarray:
        return np.bincount(stars.star, weights=half * (of_b / lb + of_c / lc), minlength=n)

    ones = np.ones(len(lb))
    weight = total(ones, ones)
    return np.stack([total(uv[stars.b, i], uv[stars.c, i]) / weight for i in range(2)], axis=1)


def _between(
    vertices: np.ndarray, uv: np.ndarray, freedom: Freedom, step: Round, which: np.ndarray
) -> np.ndarray:
    """Places (K, 2) on ∂Ω between two neighbours, at the shares of length that the mesh has."""
    v, w, a = step.vertex[which], step.target[which], step.before[which]
    after = np.linalg.norm(vertices[v] - vertices[w], axis=1)
    before = np.linalg.norm(vertices[v] - vertices[a], axis=1)
    share = (after / (before + after))[:, None]
    return uv[w] + share * (uv[a] - uv[w])


def _on_rim(
    trial: np.ndarray, one: np.ndarray, other: np.ndarray, rim: np.ndarray, freedom: Freedom
) -> np.ndarray:
    """Points of chords (N, 2), those of a mask brought to ∂Ω; a side of the square is kept to."""
    same = rim[:, None] & (one == other)
    return freedom.retract(np.where(same, one, trial), rim)
