"""Flat meshes whose boundary slides along the domain's: steps downhill, held vertices, no flips."""

from __future__ import annotations

import numpy as np
import pytest

from nsm.domains import Disc, Square, sliding
from nsm.domains.planar_mesh import flipped_triangles
from nsm.domains.tutte import tutte
from nsm.surfaces import shapes, topology

EACH = pytest.mark.parametrize("domain", [Disc(), Square()], ids=["disc", "square"])


def problem(domain, n=9):
    """A bumpy mesh with the domain's area, its layout by Tutte's embedding, and its boundary."""
    vertices, faces = shapes.plane(n)
    x, y = (vertices[:, :2] - vertices[:, :2].mean(axis=0)).T
    vertices[:, 2] = np.exp(-(((x - 0.1) ** 2 + y**2) / np.ptp(x) ** 2) * 30)
    vertices *= np.sqrt(domain.area / topology.face_areas(vertices, faces).sum())
    loop = topology.boundary_loops(faces)[0]
    boundary = domain.place_boundary(vertices, loop)
    held = np.zeros(len(vertices), dtype=bool)
    held[loop[domain.at_corner(boundary)]] = True
    held[loop[3]] = True
    return vertices, faces, tutte(vertices, faces, loop, boundary), loop, held


@EACH
def test_a_step_goes_down_the_gradient_of_the_energy(domain):
    vertices, faces, uv, loop, held = problem(domain)
    steps = sliding._Problem.of(vertices, faces, loop, held, domain)
    direction = steps.proxy_step(uv)
    assert (direction[held] == 0).all() and (direction[loop, 1] == 0).all()
    assert (direction[np.setdiff1d(np.arange(len(uv)), loop)] != 0).all()
    ahead, behind = (steps.energy(steps.moved(uv, s * 1e-6 * direction)) for s in (1, -1))
    assert ahead < steps.energy(uv) < behind
    # at its least value the proxy's second derivative along the step is what its gradient, half of
    # the energy's, is there
    rng = np.random.default_rng(0)
    for _ in range(3):
        other = rng.normal(size=uv.shape) * steps.free
        fall = [
            steps.energy(steps.moved(uv, s * 1e-6 * other / np.abs(other).max())) for s in (1, -1)
        ]
        along = (fall[0] - fall[1]) / 2e-6 * np.abs(other).max()
        assert along == pytest.approx(-2 * _proxy(steps, uv, direction, other), rel=1e-3, abs=1e-3)


def _proxy(steps, uv, one, other):
    """The proxy's second derivative by two directions, from its definition by singular values."""
    t = steps.tangents(uv)
    left = np.stack([-t[:, 1], t[:, 0]], axis=1)
    total = 0.0
    for f, gradient, area in zip(steps.faces, steps.gradient, steps.area, strict=True):
        u, s, _ = np.linalg.svd(uv[f].T @ gradient)
        weight = u @ np.diag((s - s**-3) / (s - 1)) @ u.T
        a, b = ((d[f, :1] * t[f] + d[f, 1:] * left[f]).T @ gradient for d in (one, other))
        total += area * float((a * (weight @ b)).sum())
    return total


@EACH
def test_steps_lower_the_energy_and_flip_nothing(domain):
    vertices, faces, uv, loop, held = problem(domain, 20)
    steps = sliding._Problem.of(vertices, faces, loop, held, domain)
    result = sliding.slide(vertices, faces, uv, loop, domain, 30, held)
    assert steps.energy(result) < 0.99 * steps.energy(uv)
    assert flipped_triangles(result, faces) == 0
    assert (result[held] == uv[held]).all()
    assert np.abs(domain.retract(result[loop].copy()) - result[loop]).max() < 1e-12


def test_no_step_goes_beyond_the_first_triangle_to_collapse():
    domain = Disc()
    vertices, faces, uv, loop, held = problem(domain)
    steps = sliding._Problem.of(vertices, faces, loop, held, domain)
    inner = np.setdiff1d(np.arange(len(uv)), loop)
    direction = np.zeros_like(uv)
    direction[inner] = np.random.default_rng(1).normal(size=(len(inner), 2))
    size = steps.collapse_step(uv, direction)
    assert np.isfinite(steps.energy(uv + 0.999 * size * direction))
    assert steps.energy(uv + 1.001 * size * direction) == np.inf
    assert steps.collapse_step(uv, np.zeros_like(uv)) == np.inf
