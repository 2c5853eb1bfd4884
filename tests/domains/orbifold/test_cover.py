"""Lifts of points, places on the mesh, and images under equivariant maps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from domains.orbifold.shapes import limbs, torus

from nsm.domains.orbifold import group
from nsm.domains.orbifold.cover import lifted_near, located, triangles_over_domain
from nsm.domains.orbifold.embedding import Embedding, embed_orbifold, embed_torus, twisted
from nsm.maps import EquivariantMap, LatticeAligned, SplineField, TorusMap


@pytest.fixture(scope="module", params=["orbifold", "torus"])
def embedding(request: pytest.FixtureRequest) -> Embedding:
    if request.param == "torus":
        return embed_torus(*torus())
    vertices, faces, tips = limbs()
    return embed_orbifold(vertices, faces, tips)


def _anywhere(embedding: Embedding, count: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Points of the plane, and other lifts of them."""
    rng = np.random.default_rng(0)
    sign = rng.choice([-1, 1] if embedding.cones is not None else [1], (count, 1))
    points = rng.uniform(-3, 3, (count, 2))
    return points, sign * points + 2 * rng.integers(-4, 5, (count, 2))


def test_the_nearest_lift(embedding: Embedding) -> None:
    points, others = _anywhere(embedding)
    symmetric = embedding.cones is not None
    near = points + np.random.default_rng(1).uniform(-0.05, 0.05, points.shape)
    for lattice in (None, embedding.lattice):
        found = lifted_near(others, near, symmetric, lattice)
        distance = np.linalg.norm(found - near, axis=1)
        assert (distance <= np.linalg.norm(points - near, axis=1) * 3 + 1e-9).all()
        back, _ = group.into_domain(found / 2, symmetric)
        wanted, _ = group.into_domain(points / 2, symmetric)
        gap = lifted_near(2 * back, 2 * wanted, symmetric) - 2 * wanted
        np.testing.assert_allclose(gap, 0, atol=1e-9)


def test_points_are_located(embedding: Embedding) -> None:
    points, others = _anywhere(embedding)
    symmetric = embedding.cones is not None
    for at in (points, others):
        places = located(embedding, at)
        there = np.einsum("nk,nki->ni", places.weights, embedding.corners()[places.face])
        np.testing.assert_allclose(lifted_near(there, points, symmetric), points, atol=1e-7)


@pytest.mark.parametrize("symmetric", [False, True])
def test_the_nearest_lift_in_a_sheared_basis(symmetric: bool) -> None:
    """Against all lifts that are not far, for lattices whose basis is far from reduced."""
    rng = np.random.default_rng(2)
    shift = 2 * np.stack(np.meshgrid(*[np.arange(-12, 13)] * 2), axis=-1).reshape(-1, 2)
    for _ in range(5):
        lattice = rng.normal(size=(2, 2)) @ np.array([[1, 3], [1, 4]])
        points, near = rng.uniform(-1, 1, (2, 30, 2))
        found = lifted_near(points, near, symmetric, lattice)
        lifts = points[:, None] + shift
        if symmetric:
            lifts = np.concatenate([lifts, -lifts], axis=1)
        gaps = np.linalg.norm((lifts - near[:, None]) @ lattice.T / 2, axis=2).min(axis=1)
        mine = np.linalg.norm((found - near) @ lattice.T / 2, axis=1)
        np.testing.assert_allclose(mine, gaps, atol=1e-9)


def test_lifts_of_long_triangles_cover_the_domain(embedding: Embedding) -> None:
    """Laid out in a sheared basis, triangles reach over several copies of the domain."""
    sheared = twisted(embedding, np.array([[9, 4], [2, 1]]))
    points, _ = _anywhere(embedding)
    places = located(sheared, points)
    there = np.einsum("nk,nki->ni", places.weights, sheared.corners()[places.face])
    symmetric = embedding.cones is not None
    np.testing.assert_allclose(lifted_near(there, points, symmetric), points, atol=1e-7)


def test_lifts_cover_the_domain(embedding: Embedding) -> None:
    corners, _, _ = triangles_over_domain(embedding.corners(), embedding.cones is not None)
    b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]).sum()
    assert area >= (2 if embedding.cones is not None else 4)


def _twisted(displacement: torch.nn.Module) -> LatticeAligned:
    matrix = torch.tensor([[2.0, 1.0], [1.0, 1.0]], dtype=torch.float64)
    return LatticeAligned(TorusMap.around(displacement), matrix, torch.zeros(2).double())


def test_small_equivariant_maps_are_certified(embedding: Embedding) -> None:
    torch.manual_seed(0)
    displacement = SplineField(2, 4, periodic=True).double()
    for parameter in displacement.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    if embedding.cones is not None:
        maps: list[tuple[torch.nn.Module, np.ndarray | None]] = [
            (EquivariantMap.around(displacement), None)
        ]
    else:
        maps = [
            (TorusMap.around(displacement), None),
            (_twisted(displacement), np.array([[2, 1], [1, 1]])),
        ]
    for h, matrix in maps:
        with torch.no_grad():
            image = h(torch.from_numpy(embedding.uv)).numpy()
            whole = h(torch.from_numpy(embedding.corners())).numpy()
        # the corners' images are the lifts of the vertices' images
        np.testing.assert_allclose(embedding.corners(image, matrix), whole, atol=1e-6)
        found = embedding.certificate(image, matrix)
        assert found.torn == 0 and found.degree == pytest.approx(1.0)
        assert found.injective == (not found.flipped.any())
        assert found.flipped.mean() < 0.01
