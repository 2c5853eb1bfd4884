"""Cones of several surfaces at the same four landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from nsm.domains.common_seams import edge_lengths
from nsm.domains.orbifold import group
from nsm.domains.orbifold.cones import LARGE, compared, decimated
from nsm.domains.orbifold.embedding import reduced_basis
from nsm.surfaces import topology

_CANDIDATES = 10  # landmarks
_SETS = 6  # sets of four that are laid out

Mesh = tuple[np.ndarray, np.ndarray]


def choose_common_cones(
    meshes: Sequence[Mesh],
    landmarks: Sequence[np.ndarray],
    four: Sequence[int] | np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Four landmarks that, as cones of all surfaces, make domains of little distortion.

    The candidates are landmarks that are far from each other on all surfaces. Of all their sets of
    four, those are laid out for which the product of the six distances is largest. The order is
    the one for which the lattices are least sheared.

    Args:
        meshes: vertices (V, 3) and faces (F, 3) of closed meshes of genus 0.
        landmarks: corresponding vertices (L,) of each, at least four that differ.
        four: numbers of the landmarks to take, of which the order is chosen alone.

    Returns:
        the landmarks' numbers (4,), in the order of (0, 0), (1, 0), (1, 1), (0, 1), and the mean
        over the surfaces of the mean logarithm of the distortion.
    """
    kept = distinct(landmarks) if four is None else np.asarray(four)
    places, distances = far_apart(meshes, [ids[kept] for ids in landmarks], _CANDIDATES)
    chosen = kept[places]
    closeness = -np.log(distances + np.eye(len(chosen)))
    sets = [np.array(each) for each in combinations(range(len(chosen)), 4)]
    sets.sort(key=lambda each: float(closeness[np.ix_(each, each)].sum()))
    own = [ids[chosen] for ids in landmarks]
    smaller = list(meshes)
    for k, (vertices, faces) in enumerate(meshes):
        if len(faces) > LARGE:
            coarse, ids = decimated(vertices, faces, LARGE // 2, own[k])
            smaller[k], own[k] = (vertices[ids], coarse), np.searchsorted(ids, own[k])
    # the best differ less than the surfaces' layouts on few and many faces: no second comparison
    score, best, lattices = compared(smaller, own, sets[:_SETS], again=False)[0]
    return chosen[best[_least_sheared(lattices)]], score


def distinct(landmarks: Sequence[np.ndarray]) -> np.ndarray:
    """Numbers (K,) of landmarks that are on no mesh the same vertex as an earlier one."""
    keep = np.ones(len(landmarks[0]), dtype=bool)
    for ids in landmarks:
        _, first = np.unique(ids, return_index=True)
        keep &= np.isin(np.arange(len(ids)), first)
    return np.flatnonzero(keep)


def far_apart(
    meshes: Sequence[Mesh], landmarks: Sequence[np.ndarray], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (K,) of up to ``count`` landmarks, farthest points, and their distances (K, K).

    Distances are along edges, in the unit of √area, summed over the meshes.
    """
    graphs = []
    for vertices, faces in meshes:
        unit = np.sqrt(topology.face_areas(vertices, faces).sum())
        cost = (edge_lengths(vertices, faces) / unit).clip(1e-12)
        pairs = topology.edges_of(faces).pairs
        n = len(vertices)
        graphs.append(csr_matrix((cost, tuple(pairs.T)), shape=(n, n)))

    def distance(k: int) -> np.ndarray:
        return np.asarray(
            sum(
                dijkstra(graph, directed=False, indices=ids[k])[ids]
                for graph, ids in zip(graphs, landmarks, strict=True)
            )
        )

    chosen = [int(distance(0).argmax())]
    rows = [distance(chosen[0])]
    while len(chosen) < min(count, len(landmarks[0])):
        chosen.append(int(np.min(rows, axis=0).argmax()))
        rows.append(distance(chosen[-1]))
    return np.array(chosen), np.stack(rows)[:, chosen]


def _least_sheared(lattices: Sequence[np.ndarray]) -> np.ndarray:
    """The order (4,) of cones, given in that of the lattices (2, 2), whose lattices have the
    shortest vectors."""
    best, order = np.inf, np.arange(4)
    wanted = np.rint(2 * group.CONES).astype(np.int64)
    for entries in product((-1, 0, 1), repeat=4):
        basis = np.array(entries).reshape(2, 2)
        if basis[0, 0] * basis[1, 1] - basis[0, 1] * basis[1, 0] != 1:
            continue
        cost = 0.0
        for lattice in lattices:
            other = lattice @ basis
            other = other @ reduced_basis(other, even=True)
            cost += float((other**2).sum() / np.linalg.det(other))
        if cost < best - 1e-9:
            # in the basis a cone x is at the basis' inverse times x
            back = np.array([[basis[1, 1], -basis[0, 1]], [-basis[1, 0], basis[0, 0]]])
            place = np.mod(wanted @ back.T, 2)
            best = cost
            order = np.array([int(np.flatnonzero((place == w).all(axis=1))[0]) for w in wanted])
    return order
