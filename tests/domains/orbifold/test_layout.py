"""Energies, steps, and layouts without flips."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from domains.orbifold.shapes import hull, limbs
from hypothesis import given, settings
from hypothesis import strategies as st

from nsm.domains.orbifold import group
from nsm.domains.orbifold.certificate import certificate, torn_edges
from nsm.domains.orbifold.collapses import collapsed
from nsm.domains.orbifold.cones import compared
from nsm.domains.orbifold.lifts import cone_lifts
from nsm.domains.orbifold.multiresolution import Effort, laid_out
from nsm.domains.orbifold.newton import Quotient, distortions
from nsm.domains.orbifold.stars import seen
from nsm.domains.orbifold.sweeps import relax
from nsm.domains.orbifold.triangles import Triangles
from nsm.domains.orbifold.tutte import best_lattice, edge_weights, tutte
from nsm.domains.sparse_systems import Pattern
from nsm.surfaces import topology


def _problem(seed: int = 1, count: int = 25):  # type: ignore[no-untyped-def]
    vertices, faces = hull(seed, count)
    cones = np.array([0, 6, 12, 18])
    lift, _ = cone_lifts(vertices, faces, cones.tolist())
    x, quadratic = tutte(faces, lift, edge_weights(vertices, faces, "uniform"), cones)
    lattice = best_lattice(quadratic, 4.0)
    held = np.zeros(len(vertices), dtype=bool)
    held[cones] = True
    mesh = vertices * np.sqrt(2.0 / topology.face_areas(vertices, faces).sum())
    return mesh, faces, lift, cones, held, x, lattice


def _quotient(mesh, faces, lift, held) -> Quotient:  # type: ignore[no-untyped-def]
    return Quotient(Triangles(mesh, faces, 1.0), seen(lift), held)


def _dense(pattern: Pattern, panels: np.ndarray) -> np.ndarray:
    """The symmetric matrix (2N, 2N) in a pattern's panels, in the order of its vertices."""
    n = len(pattern.ids)
    matrix = np.zeros((n, 2, n, 2))
    for f, corner in enumerate(pattern.corner.tolist()):
        for k, v in enumerate(corner):
            for m, w in enumerate(corner):
                at = pattern.place[f, k, m]
                if at >= 0:
                    for j in range(2):
                        matrix[v, :, w, j] = panels[at + j * pattern.width[f, m] :][:2]
                    matrix[w, :, v] = matrix[v, :, w].T
    return matrix.reshape(2 * n, 2 * n)


def _energy(quotient: Quotient, uv: np.ndarray, lattice: np.ndarray) -> float:
    return quotient.energy(quotient.jacobians(uv, lattice))


def test_jacobians_by_the_definition() -> None:
    mesh, faces, lift, _, held, x, lattice = _problem()
    j = _quotient(mesh, faces, lift, held).jacobians(x @ lattice.T, lattice)
    corner = group.moved(lift, x[faces]) @ lattice.T
    for f in range(len(faces)):
        flat = np.stack([mesh[faces[f, k]] - mesh[faces[f, 0]] for k in (1, 2)], axis=1)
        sides = np.stack([corner[f, k] - corner[f, 0] for k in (1, 2)], axis=1)
        # |J v| for tangents v of the triangle, by their coefficients along its sides
        inverse = np.linalg.inv(np.linalg.qr(flat)[1])
        expected = np.linalg.svd(sides @ inverse, compute_uv=False)
        assert np.linalg.svd(j[f], compute_uv=False) == pytest.approx(expected)


def test_the_gradient_is_that_of_the_energy() -> None:
    mesh, faces, lift, _, held, x, lattice = _problem()
    quotient = _quotient(mesh, faces, lift, held)
    uv = x @ lattice.T
    slope, _ = quotient.derivatives(quotient.jacobians(uv, lattice))
    rng = np.random.default_rng(0)
    for _ in range(5):
        way = rng.normal(size=uv.shape)
        way[held] = 0
        h = 1e-7
        ahead, behind = (_energy(quotient, uv + s * h * way, lattice) for s in (1, -1))
        expected = float((slope * way[quotient.mesh.pattern.ids]).sum())
        assert (ahead - behind) / (2 * h) == pytest.approx(expected, rel=1e-4)


def test_second_derivatives_are_positive() -> None:
    mesh, faces, lift, _, _, x, lattice = _problem()
    for f in range(len(faces)):  # those of each triangle
        quotient = _quotient(mesh, faces[[f]], lift[[f]], np.zeros(len(mesh), dtype=bool))
        _, panels = quotient.derivatives(quotient.jacobians(x @ lattice.T, lattice))
        hessian = _dense(quotient.mesh.pattern, panels)
        assert np.linalg.eigvalsh(hessian).min() >= -1e-9 * np.abs(hessian).max()
        assert np.abs(hessian).max() > 0


def test_second_derivatives_are_exact_where_they_are_positive() -> None:
    mesh, faces, lift, _, _, _, _ = _problem()
    nothing = np.zeros(len(mesh), dtype=bool)
    quotient = _quotient(mesh, faces, lift, nothing)
    # where nothing shrinks no eigenvalue is negative
    rng = np.random.default_rng(2)
    j = 1.5 * np.eye(2) + 0.05 * rng.normal(size=(len(faces), 2, 2))
    hessian = _dense(quotient.mesh.pattern, quotient.derivatives(j)[1])
    ids, h = quotient.mesh.pattern.ids, 1e-6
    for v in (0, 5, 17):
        for i in range(2):
            way = np.zeros((len(mesh), 2))
            way[ids[v], i] = h
            change = quotient.jacobians(way, np.zeros((2, 2)))
            ahead, behind = (quotient.derivatives(j + s * change)[0] for s in (1, -1))
            expected = ((ahead - behind) / (2 * h)).ravel()
            scale = np.abs(hessian).max()
            np.testing.assert_allclose(hessian[2 * v + i], expected, rtol=1e-4, atol=1e-4 * scale)


def _fan(count: int) -> np.ndarray:
    """Triangles around one vertex that is beside all others."""
    ring = np.arange(1, count)
    return np.stack([np.zeros_like(ring), ring, np.roll(ring, -1)], axis=1)


@pytest.mark.parametrize("held", [(), (0, 6, 12, 18)])
@pytest.mark.parametrize("faces", [*(hull(3, n)[1] for n in (4, 25, 300)), _fan(500)])
def test_sparse_systems_are_solved(held: tuple[int, ...], faces: np.ndarray) -> None:
    """Whatever the fronts: with some vertices held, their unknowns are the right-hand side's."""
    count = int(faces.max()) + 1
    pattern = Pattern(faces, count)
    assert sorted(pattern.ids.tolist()) == list(range(count))
    assert count < 300 or pattern.size < 0.1 * (2 * count) ** 2 / 2  # little is filled in
    stays = np.zeros(count, dtype=bool)
    stays[[v for v in held if v < count]] = True
    rng, panels = np.random.default_rng(0), np.zeros(pattern.size)
    for f, corner in enumerate(pattern.corner):
        part = rng.normal(size=(6, 6))
        block = (part @ part.T + 0.1 * np.eye(6)).reshape(3, 2, 3, 2)
        for k in range(3):
            for m in range(3):
                at = pattern.place[f, k, m]
                if at < 0 or stays[pattern.ids[corner[[k, m]]]].any():
                    continue
                for j in range(2):
                    start = at + j * pattern.width[f, m]
                    panels[start : start + 2] += block[k, :, m, j]
    expected = _dense(pattern, panels)
    rows = np.repeat(stays[pattern.ids], 2)
    expected[rows, rows] = 1.0
    right = rng.normal(size=(count, 2))
    found = pattern.solution(panels, right, rows.reshape(-1, 2))
    assert found is not None
    np.testing.assert_allclose(
        found.ravel(), np.linalg.solve(expected, right.ravel()), rtol=1e-6, atol=1e-6
    )


def test_a_singular_system_has_no_solution() -> None:
    _, faces = hull(3, 25)
    pattern = Pattern(faces, 25)
    right, nothing = np.ones((25, 2)), np.zeros((25, 2), dtype=bool)
    assert pattern.solution(np.zeros(pattern.size), right, nothing) is None


def test_the_lattices_best_shape() -> None:
    mesh, faces, lift, _, held, x, lattice = _problem()
    quotient = _quotient(mesh, faces, lift, held)
    uv = x @ lattice.T
    best = quotient.best_shape(quotient.jacobians(uv, lattice))
    assert np.linalg.det(best) == pytest.approx(1.0)
    least = _energy(quotient, uv @ best.T, best @ lattice)
    rng = np.random.default_rng(0)
    for size in (1e-3, 0.1, 1.0):
        for _ in range(10):
            other = best + size * rng.normal(size=(2, 2))
            if np.linalg.det(other) <= 0.01:
                continue
            other /= np.sqrt(np.linalg.det(other))
            assert _energy(quotient, uv @ other.T, other @ lattice) >= least - 1e-9 * least


def test_distortion_by_the_definition() -> None:
    vertices, faces, lift, _, _, x, lattice = _problem()
    found = distortions(vertices, faces, lift, x, lattice)
    corner = group.moved(lift, x[faces]) @ lattice.T
    for f in range(len(faces)):
        a, b, c = vertices[faces[f]]
        u = (b - a) / np.linalg.norm(b - a)
        n = np.cross(b - a, c - a)
        v = np.cross(n / np.linalg.norm(n), u)
        flat = np.array([[(b - a) @ u, (c - a) @ u], [(b - a) @ v, (c - a) @ v]])
        p = corner[f]
        jacobian = np.stack([p[1] - p[0], p[2] - p[0]], axis=1) @ np.linalg.inv(flat)
        m = jacobian.T @ jacobian
        value = np.trace(m) + np.trace(np.linalg.inv(m + 0.01 * np.eye(2)))
        assert found[f] == pytest.approx(value, rel=1e-6)


def test_steps_and_sweeps_lower_the_energy_and_flip_nothing() -> None:
    mesh, faces, lift, cones, held, x, lattice = _problem(4, 60)
    quotient = _quotient(mesh, faces, lift, held)
    uv = x @ lattice.T
    j = quotient.jacobians(uv, lattice)
    energies = [quotient.energy(j)]
    for _ in range(10):
        uv, there, value, _ = quotient.step(uv, lattice, j)
        assert there == pytest.approx(quotient.jacobians(uv, lattice))
        energies.append(value)
        relax(uv, lattice, quotient.mesh.stars, seen(lift), held)
        j = quotient.jacobians(uv, lattice)
        energies.append(quotient.energy(j))
    assert (np.diff(energies) <= 1e-9 * energies[0]).all()
    assert energies[-1] < 0.9 * energies[0]
    x = np.linalg.solve(lattice, uv.T).T
    x[cones] = group.CONES
    assert certificate(faces, lift, x, cones).injective


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000))
def test_collapses_leave_a_sphere(seed: int) -> None:
    vertices, faces = hull(seed, 50)
    held = np.zeros(len(vertices), dtype=bool)
    held[:4] = True
    coarse, rounds = collapsed(vertices, faces, held, 16)
    a, b, c = coarse.T
    left = coarse[(a != b) & (b != c) & (c != a)]
    assert len(left) <= 20 and set(range(4)) <= set(left.ravel().tolist())
    assert topology.euler_characteristic(left) == 2
    assert (topology.edges_of(left).count == 2).all()
    for step in reversed(rounds):  # undone, they give the mesh back
        coarse.ravel()[step.corners] = step.vertex[step.star]
    np.testing.assert_array_equal(coarse, faces)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_layouts_are_homeomorphisms_with_little_distortion(seed: int) -> None:
    vertices, faces = hull(seed, 400)
    cones = np.random.default_rng(seed).choice(len(vertices), 4, replace=False)
    lift, _ = cone_lifts(vertices, faces, cones.tolist())
    layout = laid_out(vertices, faces, lift, cones, effort=Effort(coarse=200))
    assert torn_edges(faces, layout.lift, cones) == 0
    x = np.linalg.solve(layout.lattice, layout.uv.T).T
    x[cones] = group.CONES
    assert certificate(faces, layout.lift, x, cones).injective
    start, quadratic = tutte(faces, lift, edge_weights(vertices, faces, "mean_value"), cones)
    before = distortions(vertices, faces, lift, start, best_lattice(quadratic, 4.0))
    after = distortions(vertices, faces, layout.lift, x, layout.lattice)
    area = topology.face_areas(vertices, faces)
    assert area @ after < area @ before


def test_long_limbs_that_tutte_squeezes_are_recovered() -> None:
    vertices, faces, tips = limbs()
    vertices = vertices * (1.0, 1.0, 1.0)
    # three cones in one place: the limbs have none
    cones = np.array([tips[0], *faces[5]])
    lift, _ = cone_lifts(vertices, faces, cones.tolist())
    layout = laid_out(vertices, faces, lift, cones)
    x = np.linalg.solve(layout.lattice, layout.uv.T).T
    x[cones] = group.CONES
    assert certificate(faces, layout.lift, x, cones).injective


def test_sets_of_cones_that_one_mesh_excludes_change_nothing() -> None:
    """The best set is the best of all, each laid out on all meshes."""
    points, faces, tips = limbs()
    bent = points * [1.3, 0.9, 1.0] + 0.2 * np.sin(points[:, [1, 2, 0]])
    own = np.array([*tips, points[:, 2].argmin(), points[:, 2].argmax()])
    sets = [np.array(four) for four in combinations(range(len(own)), 4)][:4]
    meshes = [(points, faces), (bent, faces)]
    mean, best, _ = compared(meshes, [own, own], sets, again=False)[0]
    every = [
        [compared([mesh], [own], [four], again=False)[0][0] for mesh in meshes] for four in sets
    ]
    assert mean == pytest.approx(np.mean(every, axis=1).min(), rel=1e-9)
    assert (best == sets[int(np.mean(every, axis=1).argmin())]).all()
