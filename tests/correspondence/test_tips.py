"""Ends of limbs: maxima of the mean distance and their prominences."""

import numpy as np
import pytest
import trimesh
from limbs import star
from scipy.sparse.csgraph import connected_components

from nsm.correspondence import tips
from nsm.correspondence.distances import edge_distances
from nsm.domains.orbifold.cones import extremities
from nsm.surfaces.geometry import edge_graph
from nsm.surfaces.topology import face_areas


def by_definition(graph, values):
    """Prominences from all superlevel sets: the set's highest vertex, until a higher one is in."""
    height = {}
    for v in range(len(values)):
        best = None
        for level in np.sort(values[values <= values[v]])[::-1]:
            inside = np.flatnonzero(values >= level)
            parts = connected_components(graph[inside][:, inside], directed=False)[1]
            mine = inside[parts == parts[np.searchsorted(inside, v)]]
            if (values[mine] > values[v]).any():
                break
            best = level
        if best is None:
            continue
        below = values[values < best]
        height[v] = values[v] - (below.max() if len(below) else best)
    return {v: h for v, h in height.items() if h > 0}


@pytest.mark.parametrize("seed", [0, 1])
def test_prominences_are_those_of_their_definition(seed):
    ball = trimesh.creation.icosphere(subdivisions=1)
    faces = np.array(ball.faces)
    values = np.random.default_rng(seed).permutation(len(ball.vertices)).astype(float)
    graph = edge_graph(np.array(ball.vertices), faces)
    maxima, height = tips.prominences(faces, values)
    expected = by_definition((graph + graph.T).tocsr(), values)
    neighbours = graph + graph.T
    local = [v for v in range(len(values)) if (values[neighbours[v].indices] < values[v]).all()]
    assert sorted(maxima.tolist()) == local
    assert (np.diff(height) <= 0).all()
    for v, h in zip(maxima.tolist(), height.tolist(), strict=True):
        assert h == expected[v] or v == values.argmax() and h == np.ptp(values)


def test_a_limb_that_the_extremities_miss_is_a_tip(monkeypatch):
    vertices, faces, ends = star([2.6, 1.9, 1.3, 1.6, 2.2])
    far = extremities(vertices, faces, 8)
    unit = np.sqrt(face_areas(vertices, faces).sum())
    apart = edge_distances(vertices, faces, ends)[:, far] / unit
    assert (apart.min(axis=1) < 0.1).all()
    missing = far[apart[2] > 0.3]
    monkeypatch.setattr(tips, "extremities", lambda *_: missing)
    found = tips.tips_of(vertices, faces, 8)
    assert set(missing) < set(found)
    (added,) = set(found) - set(missing)
    assert edge_distances(vertices, faces, ends[2:3])[0, added] / unit < 0.1


def test_mean_distances_from_few_sources_are_those_from_all():
    vertices, faces, _ = star([1.0, 0.5, 0.0, 0.0, 0.0])
    area = face_areas(vertices, faces)
    corner = np.bincount(faces.ravel(), np.repeat(area / 3, 3))
    few = tips.mean_distances(vertices, faces, area)
    some = np.arange(0, len(vertices), 50)
    every = edge_distances(vertices, faces, some) @ corner / area.sum()
    assert few[some] == pytest.approx(every, rel=0.02)
