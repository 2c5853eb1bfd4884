"""Correspondences of two closed surfaces without landmarks: hypotheses, best first.

Tips are matched in fours. Four tips at the cones of the orbifold give a map, injective and
orientation-preserving, in one sparse solve; the cheap scores of thousands of these choose which are
trained for a moment, and least distortion chooses among those (as in ENIGMA, Edelstein, Ezuz and
Ben-Chen 2020, "ENIGMA: Evolutionary non-isometric geometry matching").
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
import torch
from torch import Tensor

from nsm.correspondence.coarse_shape import CoarseShape, coarse_shape
from nsm.correspondence.layouts import Layout, Table, affine_maps, layout, quick_scores, table
from nsm.correspondence.refinement import Batch, Sines, refined
from nsm.domains.orbifold.cover import located
from nsm.domains.orbifold.embedding import SIDE

_SOURCE_SETS = 4
_TARGET_SETS = 20
_ROUNDS = ((400, 3, 12), (80, 5, 25), (16, 8, 40))  # maps, largest wave, steps
_GEODESIC = 2.0  # weights beside the logarithm of the energy
_RIGID = 1.0


@dataclass(frozen=True)
class Candidate:
    """A map of the orbifold that may be the right one: x ↦ B (x + n(x)) + c."""

    source: Layout
    target: Layout
    matrix: np.ndarray
    shift: np.ndarray
    amplitudes: np.ndarray
    energy: float
    image: np.ndarray

    def planar(self, x: np.ndarray) -> np.ndarray:
        """Points (N, 2) of the source's Ω to points (N, 2) of the target's."""
        moved = x.copy()
        if len(self.amplitudes):
            largest = int((np.sqrt(2 * len(self.amplitudes) + 1) - 1) / 2)
            moved += Sines.up_to(largest).basis(x)[0] @ self.amplitudes
        return np.asarray(moved @ self.matrix.T + self.shift)


def search(source: CoarseShape, target: CoarseShape):  # type: ignore[no-untyped-def]
    sets, scores = quick_scores(source)
    chosen = sets[np.argsort(scores)[:_SOURCE_SETS]]
    ours = [found for found in (layout(source, four) for four in chosen) if found is not None]
    wanted = target_sets(ours, target, _TARGET_SETS)
    theirs = [found for found in (layout(target, four) for four in wanted) if found is not None]
    tables = [table(t) for t in theirs]
    starts = []
    for i, s in enumerate(ours):
        for j, t in enumerate(theirs):
            maps = affine_maps(s, t)
            matrices = np.stack([m for m, _ in maps])
            shifts = np.stack([c for _, c in maps])
            cost = geodesic_cost(s, tables[j], target, matrices, shifts)
            starts += [(c, i, j, m, sh) for c, m, sh in zip(cost, matrices, shifts, strict=True)]
    starts.sort(key=lambda e: e[0])
    state = [(e[1], e[2], e[3], e[4], np.zeros((0, 2)), 0.0) for e in starts]
    for count, largest, steps in _ROUNDS:
        state = one_round(ours, tables, state[:count], largest, steps)
        costs = [x[5] for x in state]
        order = np.argsort(costs)
        state = [state[k] for k in order]
    return ours, theirs, tables, state


def one_round(ours, tables, state, largest, steps):
    result = []
    waves = len(Sines.up_to(largest).waves)
    for i, s in enumerate(ours):
        mine = [e for e in state if e[0] == i]
        if not mine:
            continue
        batch = Batch(s, tables, np.array([e[1] for e in mine]), np.stack([e[2] for e in mine]), np.stack([e[3] for e in mine]), largest)
        start = torch.zeros(len(mine), waves, 2)
        for k, e in enumerate(mine):
            start[k, : len(e[4])] = torch.as_tensor(e[4], dtype=torch.float32)
        x, energy = refined(batch, start, steps)
        for e, a, v in zip(mine, x.numpy().astype(float), energy.tolist(), strict=True):
            result.append((*e[:4], a, v))
    return result


def target_sets(ours, target, count):
    best = {}
    d, m = target.distance[np.ix_(target.tips, target.tips)], target.mean_distance[target.tips]
    orders = np.array(list(permutations(range(len(target.tips)), 4)))
    upper = np.triu_indices(4, 1)
    for s in ours:
        shape = s.shape
        tips = shape.tips[s.tips]
        a = shape.distance[np.ix_(tips, tips)][upper]
        b = d[orders[:, upper[0]], orders[:, upper[1]]]
        cost = np.abs(a - b).mean(axis=1) + np.abs(shape.mean_distance[tips] - m[orders]).mean(axis=1)
        for c, o in zip(cost.tolist(), np.sort(orders, axis=1).tolist(), strict=True):
            key = tuple(o)
            best[key] = min(best.get(key, np.inf), c)
    return np.array(sorted(best, key=best.get)[:count])


def geodesic_cost(s, t, target, matrices, shifts, moved=None):
    """Mean difference of geodesic distances between samples and between their images (H,)."""
    shape = s.shape
    uv = s.embedding.uv[shape.samples] if moved is None else moved
    y = np.einsum("hij,nj->hni", matrices, uv) + shifts[:, None]
    n = len(t.vertex)
    k = np.mod(np.rint(0.5 * n * y).astype(int), n)
    image = t.vertex[k[..., 0], k[..., 1]]
    a = shape.distance[np.ix_(shape.samples, shape.samples)]
    b = target.distance[image[:, :, None], image[:, None, :]]
    return np.abs(a - b).mean(axis=(1, 2))


def rigid(s, t, target, matrix, shift, moved):
    shape = s.shape
    y = moved @ matrix.T + shift
    n = len(t.vertex)
    k = np.mod(np.rint(0.5 * n * y).astype(int), n)
    image = target.vertices[t.vertex[k[..., 0], k[..., 1]]]
    p = shape.vertices[shape.samples]
    p = p - p.mean(0); q = image - image.mean(0)
    u, sv, vt = np.linalg.svd(p.T @ q)
    d = np.sign(np.linalg.det(u @ vt))
    r = u @ np.diag([1, 1, d]) @ vt
    return float(np.sqrt(((p @ r - q) ** 2).sum(1).mean()))
