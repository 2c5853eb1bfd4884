"""Meshes drawn together and put back: exact undoing, no flips, boundaries kept, less distortion."""

import numpy as np
import pytest
import torch

from nsm.domains import Disc, Surface, domain, embedding
from nsm.domains.coarse_to_fine import embed_coarse_to_fine
from nsm.domains.decimation import Rings, coarsen, present_faces, undo
from nsm.domains.planar_mesh import boundary_self_intersections, flipped_triangles
from nsm.domains.tutte import tutte
from nsm.domains.vertex_relaxation import Freedom, Stars, relax
from nsm.errors import NsmError
from nsm.surfaces import shapes, topology
from nsm.surfaces.geometry import triangle_distortion


def bumpy(n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = shapes.plane(n)
    vertices[:, 2] = 0.3 * np.sin(4 * vertices[:, 0]) * np.cos(3 * vertices[:, 1])
    return vertices * np.sqrt(np.pi / topology.face_areas(vertices, faces).sum()), faces


def test_rounds_leave_discs_and_are_undone():
    vertices, faces = bumpy(61)
    held = np.zeros(len(vertices), dtype=bool)
    held[[0, 60, 700]] = True
    current, rounds = coarsen(vertices, faces, held, 600)
    coarse = present_faces(current)
    assert 400 < len(coarse) <= 600
    assert topology.is_disc(coarse)
    assert held[coarse].sum() >= 3
    assert not held[np.concatenate([r.vertex for r in rounds])].any()
    edges = topology.edges_of(coarse)
    on_boundary = np.zeros(len(vertices), dtype=bool)
    on_boundary[edges.pairs[edges.count == 1]] = True
    assert not (on_boundary[edges.pairs].all(axis=1) & (edges.count == 2)).any()  # no chords
    for step in reversed(rounds):
        undo(current, step)
    assert np.array_equal(current, faces)


def test_vertices_of_a_set_are_apart():
    faces = shapes.sphere(3)[1]
    rings = Rings(faces, faces.max() + 1)
    chosen = np.flatnonzero(rings.apart(np.random.default_rng(0).uniform(size=faces.max() + 1), 2))
    near = [set(rings.indices[rings.start[v] : rings.start[v + 1]].tolist()) | {v} for v in chosen]
    assert len(chosen) > 20
    assert sum(map(len, near)) == len(set().union(*near))


def test_derivatives_of_a_star():
    vertices, faces = bumpy(12)
    loop = topology.boundary_loops(faces)[0]
    uv = tutte(vertices, faces, loop, Disc().place_boundary(vertices, loop))
    face, k = np.nonzero(faces == 5 * 12 + 5)
    b, c = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
    star = Stars.of(vertices, np.array([65]), np.zeros(len(face), dtype=np.int64), b, c)
    energy, gradient, second = star.derivatives(uv)
    value = triangle_distortion(uv, vertices, faces, eps=0.0)[face]
    area = topology.face_areas(vertices, faces)[face]
    assert energy[0] == pytest.approx((value * area).sum())
    step = 1e-6 * np.eye(2)
    slope = [(star.energy(uv, uv[65:66] + s) - star.energy(uv, uv[65:66] - s)) / 2e-6 for s in step]
    assert gradient[0] == pytest.approx(np.ravel(slope), rel=1e-5)
    bend = []
    for s in step:
        ahead, behind = uv.copy(), uv.copy()
        ahead[65] += s
        behind[65] -= s
        bend.append((star.derivatives(ahead)[1] - star.derivatives(behind)[1])[0] / 2e-6)
    assert np.array(bend) == pytest.approx(second[0][[[0, 1], [1, 2]]], rel=1e-5)


def test_a_step_lowers_the_energy_and_keeps_to_the_boundary():
    vertices, faces = bumpy(12)
    loop = topology.boundary_loops(faces)[0]
    uv = tutte(vertices, faces, loop, Disc().place_boundary(vertices, loop))
    on_boundary = np.zeros(len(vertices), dtype=bool)
    on_boundary[loop] = True
    held = np.zeros(len(vertices), dtype=bool)
    vertex = loop[3]
    face, k = np.nonzero(faces == vertex)
    b, c = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
    star = Stars.of(vertices, np.array([vertex]), np.zeros(len(face), dtype=np.int64), b, c)
    before, place = star.energy(uv, uv[[vertex]]), uv[vertex].copy()
    relax(uv, star, Freedom(on_boundary, held, Disc()))
    assert star.energy(uv, uv[[vertex]]) < before
    assert not np.array_equal(uv[vertex], place)
    assert np.linalg.norm(uv[vertex]) == pytest.approx(1, abs=1e-12)
    held[vertex], place = True, uv[vertex].copy()
    relax(uv, star, Freedom(on_boundary, held, Disc()))
    assert np.array_equal(uv[vertex], place)


def test_a_bad_start_is_put_back_without_flips():
    """Tutte's embedding of the coarse mesh of a long shape: far from what the mesh would like."""
    vertices, faces = shapes.cone(40, height=4.0)
    vertices = vertices * np.sqrt(np.pi / topology.face_areas(vertices, faces).sum())
    loop = topology.boundary_loops(faces)[0]
    boundary = Disc().place_boundary(vertices, loop)
    none = np.zeros(len(vertices), dtype=bool)
    uv = embed_coarse_to_fine(
        vertices, faces, loop, boundary, Disc(), none, lambda v, f, r, b, h: tutte(v, f, r, b), 300
    )
    assert uv is not None
    assert flipped_triangles(uv, faces) == 0


@pytest.mark.parametrize("name", ["disc", "square"])
def test_as_good_as_at_once(name, monkeypatch):
    vertices, faces = shapes.sphere(3)
    vertices = vertices * (1 + 0.2 * np.sin(3 * vertices[:, :1]) * np.cos(4 * vertices[:, 1:2]))
    at_once = Surface.from_arrays(vertices, faces, domain=name)
    monkeypatch.setattr(embedding, "LARGE", 1000)
    monkeypatch.setattr(embedding, "COARSE", 500)
    calls = []
    solver = embedding.slide
    monkeypatch.setattr(embedding, "slide", lambda *a: calls.append(len(a[1])) or solver(*a))
    surface = Surface.from_arrays(vertices, faces, domain=name)
    assert calls and max(calls) <= 500
    assert flipped_triangles(surface.uv, surface.faces) == 0
    loop = topology.boundary_loops(surface.faces)[0]
    assert boundary_self_intersections(surface.uv, loop) == 0
    distance = domain(name).signed_distance(torch.from_numpy(surface.uv[loop]))
    assert distance.abs().max() <= 1e-12
    assert (
        surface.quality["median_symmetric_dirichlet"]
        <= 1.01 * at_once.quality["median_symmetric_dirichlet"]
    )


def test_what_does_not_carry_over_is_laid_out_at_once(monkeypatch):
    monkeypatch.setattr(embedding, "LARGE", 500)
    monkeypatch.setattr(embedding, "embed_coarse_to_fine", lambda *_: None)
    vertices, faces = bumpy(20)
    surface = Surface.from_arrays(vertices, faces)
    assert any("laid out at once" in line for line in surface.log)
    assert flipped_triangles(surface.uv, surface.faces) == 0


def finger(around: int, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """A tube of the disc's area, open below and closed at its tip, which Tutte puts off centre."""
    angle = 2 * np.pi * (np.arange(around) / around) ** 1.5
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    up = 0.6 * np.arange(rings)[:, None, None] * [0.0, 0.0, 1.0]
    vertices = np.concatenate([(ring + up).reshape(-1, 3), [[0.0, 0.0, 0.6 * rings]]])
    k, i = np.divmod(np.arange((rings - 1) * around), around)
    a, b = k * around + i, k * around + (i + 1) % around
    sides = np.concatenate(
        [np.stack(t, axis=1) for t in ((a, b, b + around), (a, b + around, a + around))]
    )
    last, i = (rings - 1) * around, np.arange(around)
    tip = np.stack([last + i, last + (i + 1) % around, np.full(around, rings * around)], axis=1)
    faces = np.concatenate([sides, tip])
    return vertices * np.sqrt(np.pi / topology.face_areas(vertices, faces).sum()), faces


def test_a_long_finger_is_laid_out_where_tuttes_embedding_loses_precision():
    vertices, faces = finger(8, 90)
    with pytest.raises(NsmError) as error:
        embedding.embed(Disc(), vertices, faces, method="tutte")
    assert error.value.kind == "not_injective"
    layout = embedding.embed(Disc(), vertices, faces)
    assert any("coarse to fine" in line for line in layout.log)
    assert flipped_triangles(layout.uv, faces) == 0
    assert boundary_self_intersections(layout.uv, topology.boundary_loops(faces)[0]) == 0
