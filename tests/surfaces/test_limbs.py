"""Limbs that a seam does not reach, and seams that are led on to their tips."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from limbs import star
from scipy.sparse.csgraph import dijkstra

from nsm.surfaces.cutting import cut_to_disc
from nsm.surfaces.geometry import edge_graph
from nsm.surfaces.limbs import limb_tips


def tube(length, radius=1.0, rings=60):
    """A tube along z with a round end at z = length + radius, as vertices and faces."""
    arc = np.linspace(0, np.pi / 2, 12)[1:]
    z = np.concatenate([np.linspace(0, length, rings), length + radius * np.sin(arc[:-1])])
    r = np.concatenate([np.full(rings, radius), radius * np.cos(arc[:-1])])
    angle = np.arange(48) * 2 * np.pi / 48
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rows = [np.column_stack([r[k] * around, np.full(48, z[k])]) for k in range(len(z))]
    vertices = np.concatenate([*rows, [[0, 0, length + radius]]])
    k, j = np.meshgrid(np.arange(len(z) - 1), np.arange(48), indexing="ij")
    a, b = (48 * k + j).ravel(), (48 * k + (j + 1) % 48).ravel()
    last = 48 * (len(z) - 1)
    top = [(last + i, last + (i + 1) % 48, len(vertices) - 1) for i in range(48)]
    sides = [np.column_stack([a, b, b + 48]), np.column_stack([a, b + 48, a + 48])]
    return vertices, np.concatenate([*sides, top])


def from_base(vertices):
    """The distances (V,) from the open end of a tube of radius 1, in closed form."""
    z = vertices[:, 2]
    length = z.max() - 1
    return np.where(z < length, z, length + np.arcsin(np.clip(z - length, 0, 1)))


@pytest.mark.parametrize(("length", "found"), [(0.5, False), (1.0, False), (1.8, True), (8, True)])
def test_a_tube_is_a_limb_when_it_is_higher_than_two_and_a_half_radii(length, found):
    """Above the lowest level, 0.05 √area, its height over its radius is L + π/2 − 0.05 √area."""
    vertices, faces = tube(length)
    low = 0.05 * np.sqrt(2 * np.pi * (length + 1))
    assert (length + np.pi / 2 - low > 2.5) == found
    tips = limb_tips(vertices, faces, from_base(vertices))
    assert tips == ([len(vertices) - 1] if found else [])


def test_halves_of_a_ball_are_no_limbs():
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    assert limb_tips(vertices, faces, np.abs(np.arcsin(np.clip(vertices[:, 2], -1, 1)))) == []


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_limbs_do_not_depend_on_place_unit_and_order(seed, unit):
    generator = np.random.default_rng(seed)
    vertices, faces, tips = star([5.2, 3.8, 2.6, 3.2, 4.4], width=0.2)
    around = dijkstra(edge_graph(vertices, faces), directed=False, indices=int(tips[0]))
    order = generator.permutation(len(vertices))
    place = np.argsort(order)
    turned = unit * vertices[order] @ np.linalg.qr(generator.normal(size=(3, 3)))[0]
    plain = limb_tips(vertices, faces, around)
    assert limb_tips(turned, place[faces], unit * around[order]) == place[plain].tolist()
    apart = np.linalg.norm(vertices[plain][:, None] - vertices[tips], axis=2)
    assert len(plain) == 4 and (apart.min(axis=1) < 0.3).all()  # an edge from the tip at most


def test_the_seam_visits_the_tip_of_each_limb():
    arms = [(np.cos(a), np.sin(a), 0.0) for a in np.arange(9) * 2 * np.pi / 9]
    ball = trimesh.creation.icosphere(subdivisions=5)
    points = np.array(ball.vertices)
    angle = np.arccos(np.clip(points @ np.array(arms).T, -1, 1))
    long = 1 + 4 * np.exp(-((angle / 0.2) ** 2)).sum(axis=1)
    cut = cut_to_disc(long[:, None] * points, np.array(ball.faces))
    on_seam = np.array(sorted(set(cut.origin[cut.loop].tolist()) - {-1}))
    assert (angle[on_seam].min(axis=0) < 0.06).all()  # an edge or two from the tip
    assert any("tips of limbs" in line for line in cut.log)
