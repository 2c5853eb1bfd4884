"""Surfaces with handles: what the search takes for them, and what it finds as landmarks of them.

The source is cut open in one way, the target in several, with the caps in all orders in which they
may correspond. A map of surfaces that were cut open gives landmarks of the whole ones: tips that
are no caps, a point on the tube of each handle, and points between, where the map distorts little.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape, coarse_shape
from nsm.correspondence.distances import edge_distances
from nsm.correspondence.opened_handles import Opened, ways_to_open
from nsm.correspondence.search import Candidate
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.wording import number_of

Mesh = tuple[np.ndarray, np.ndarray]

_OPENED = 24  # targets at most
_AROUND = 0.4  # of a point: where the change of distances tells how much a map distorts, over √area


def has_handles(mesh: Mesh) -> bool:
    """Whether a mesh is closed, in one part, and not of genus 0."""
    faces = mesh[1]
    if (topology.edges_of(faces).count != 2).any() or topology.face_components(faces).max():
        return False
    return topology.euler_characteristic(faces) != 2


def opened_shapes(
    source: Mesh, target: Mesh, given: np.ndarray
) -> tuple[CoarseShape, list[CoarseShape]]:
    """The coarse shape of a surface with handles, cut open in one way, and those of another one of
    the same genus, cut open in several.

    Caps are fixed, as landmarks that are given, in all orders in which they may correspond. Of many
    shapes the ones are kept whose fixed tips are apart as those of the source.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        given: (G, 2) landmarks of both, which come before the caps.

    Raises:
        NsmError: ``wrong_topology``: their genus differs; or as
            :func:`nsm.correspondence.opened_handles.ways_to_open`.
    """
    genus = [topology.genus_and_boundary(faces)[0] for _, faces in (source, target)]
    if genus[0] != genus[1]:
        raise NsmError(
            f"the surfaces have {number_of(genus[0], 'handle')} and {genus[1]}; nothing "
            "corresponds to a handle",
            kind="wrong_topology",
            key="landmarks",
        )
    first = _opened_shape(ways_to_open(*source, given[:, 0])[0], given[:, 0])
    every = []
    for way in ways_to_open(*target, given[:, 1]):
        shape = _opened_shape(way, given[:, 1])
        for order in way.orders():
            fixed = np.concatenate([np.arange(len(given)), len(given) + order])
            tips = np.concatenate([shape.tips[fixed], shape.tips[len(fixed) :]])
            every.append(replace(shape, tips=tips))
    costs = [_unlike(first, one) for one in every]
    return first, [every[k] for k in np.argsort(costs, kind="stable")[:_OPENED]]


def _opened_shape(way: Opened, fixed: np.ndarray) -> CoarseShape:
    own = [int(np.flatnonzero(way.origin == v)[0]) for v in fixed]
    ends = np.concatenate([np.array(own, dtype=np.int64), way.caps])
    return coarse_shape(*way.arrays, fixed=ends, opened=way)


def _unlike(source: CoarseShape, target: CoarseShape) -> float:
    """By how much the distances between fixed tips differ, and their mean distances."""
    apart = [s.distance[np.ix_(s.fixed, s.fixed)] for s in (source, target)]
    mean = [s.mean_distance[s.fixed] for s in (source, target)]
    return float(np.abs(apart[0] - apart[1]).mean() + np.abs(mean[0] - mean[1]).mean())


def on_whole(
    candidate: Candidate, pairs: np.ndarray, least: int, meshes: tuple[Mesh, Mesh]
) -> np.ndarray:
    """Landmarks (L, 2), vertices of whole surfaces, of a map of what was cut out of them.

    Args:
        candidate: the map.
        pairs: (K, 2) corresponding vertices of its shapes' meshes, given ones first; those on caps
            are left out.
        least: how many there are to be, if the map brings as many to vertices of their own.
        meshes: vertices (V, 3) and faces (F, 3) of the whole surfaces. With two handles or more,
            which have no domain without a seam, landmarks that were not given have room for it.
    """
    shapes = candidate.source.shape, candidate.target.shape
    on_caps = [np.isin(pairs[:, k], shape.mesh.caps) for k, shape in enumerate(shapes)]
    found = np.concatenate([pairs[~on_caps[0] & ~on_caps[1]], _on_tubes(candidate)])
    found = np.concatenate([found, _between(candidate, found, least - len(found))])
    ends = np.stack([shape.mesh.origin[found[:, k]] for k, shape in enumerate(shapes)], axis=1)
    if len(shapes[0].mesh.caps) > 2:
        free = slice(shapes[0].given_landmarks, None)
        for k, (_, faces) in enumerate(meshes):
            ends[free, k] = with_room(faces)[ends[free, k]]
    # each vertex once
    ours, theirs = (np.unique(column, return_index=True)[1] for column in ends.T)
    return ends[np.intersect1d(ours, theirs)]


def with_room(faces: np.ndarray) -> np.ndarray:
    """Of each vertex (V,) of a mesh (F, 3), it or the neighbour of it that has most neighbours.

    Seams through handles pass landmarks many times; one with four neighbours leaves them no way.
    """
    count = np.bincount(faces.ravel())
    best = np.arange(len(count))
    pairs = topology.edges_of(faces).pairs
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    ends = ends[np.argsort(count[ends[:, 1]], kind="stable")]  # the last one stays
    more = count[ends[:, 1]] > count[ends[:, 0]]
    best[ends[more, 0]] = ends[more, 1]
    return best


def _on_tubes(candidate: Candidate) -> np.ndarray:
    """Of each handle a pair (g, 2) of vertices of the meshes, on the curves along which its tubes
    were cut, that the map brings nearest to each other."""
    source, target = candidate.source.shape, candidate.target.shape
    ours, theirs = (shape.fixed[shape.given_landmarks :] for shape in (source, target))
    found, costs = [], []
    for cap, its_cap in zip(ours.tolist(), theirs.tolist(), strict=True):
        around = np.setdiff1d(source.faces[(source.faces == cap).any(axis=1)], [cap])
        ends = ((source, cap, around), (target, its_cap, candidate.images(around)))
        near = []
        for shape, middle, points in ends:
            faces = shape.mesh.faces
            rim = np.setdiff1d(faces[(faces == shape.ids[middle]).any(axis=1)], shape.ids[middle])
            apart = edge_distances(*shape.mesh.arrays, shape.ids[points])[:, rim]
            unit = np.sqrt(topology.face_areas(*shape.mesh.arrays).sum())
            near.append((rim[apart.argmin(axis=1)], apart.min(axis=1) / unit))
        cost = near[0][1] + near[1][1]
        k = int(cost.argmin())
        found.append((near[0][0][k], near[1][0][k]))
        costs.append(float(cost[k]))
    better = np.array(costs).reshape(-1, 2).argmin(axis=1)
    return np.array(found, dtype=np.int64).reshape(-1, 2, 2)[np.arange(len(better)), better]


def _between(candidate: Candidate, known: np.ndarray, count: int) -> np.ndarray:
    """Pairs (count, 2) of vertices of the meshes: samples around which the map changes distances
    less than around most, far from known pairs (L, 2) and from caps; and their images."""
    source, target = candidate.source.shape, candidate.target.shape
    points, images = source.samples, candidate.images(source.samples)
    before = source.distance[np.ix_(points, points)]
    change = np.abs(before - target.distance[np.ix_(images, images)])
    around = before < _AROUND
    change = (change * around).sum(axis=1) / around.sum(axis=1)
    far = np.where(change <= np.median(change), np.inf, 0.0)
    for shape, ends, ids in ((source, points, known[:, 0]), (target, images, known[:, 1])):
        there = edge_distances(*shape.mesh.arrays, np.concatenate([ids, shape.mesh.caps]))
        far = np.minimum(far, there[:, shape.ids[ends]].min(axis=0))
    chosen: list[int] = []
    while len(chosen) < count:
        k = int(far.argmax())
        chosen.append(k)
        far = np.minimum(far, source.distance[points[k], points])
        far = np.minimum(far, target.distance[images[k], images])
    return np.stack([source.ids[points[chosen]], target.ids[images[chosen]]], axis=1)
