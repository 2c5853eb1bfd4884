"""Embeddings of closed surfaces, whole."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from domains.orbifold.shapes import limbs, torus
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nsm.domains.orbifold import embedding as embedding_module
from nsm.domains.orbifold.certificate import torn_edges
from nsm.domains.orbifold.cones import choose_cones, extremities
from nsm.domains.orbifold.embedding import (
    Embedding,
    embed_orbifold,
    embed_torus,
    in_order,
    reduced_basis,
    twisted,
)
from nsm.errors import NsmError


@pytest.fixture(scope="module")
def embedded() -> tuple[np.ndarray, Embedding, list[int]]:
    vertices, faces, tips = limbs()
    return vertices, embed_orbifold(vertices, faces, tips), tips


def test_cones_lie_where_they_should(embedded: tuple[np.ndarray, Embedding, list[int]]) -> None:
    vertices, embedding, tips = embedded
    assert embedding.cones is not None
    np.testing.assert_array_equal(embedding.cones, tips)
    np.testing.assert_array_equal(embedding.uv[tips], [[0, 0], [1, 0], [1, 1], [0, 1]])
    assert len(embedding.uv) == len(vertices)
    assert (embedding.uv >= (-1, 0)).all() and (embedding.uv <= 1).all()
    assert np.linalg.det(embedding.lattice) == pytest.approx(4.0)
    assert embedding.certificate().injective
    corners = embedding.corners()
    b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    assert (area > 0).all() and area.sum() == pytest.approx(2.0)


def test_a_rotated_surface_is_laid_out_as_well(
    embedded: tuple[np.ndarray, Embedding, list[int]],
) -> None:
    vertices, embedding, tips = embedded
    before = np.median(embedding.distortions(vertices))
    turned = vertices @ Rotation.from_euler("xyz", [0.3, 1.1, -2.0]).as_matrix().T * 7 + 3
    other = embed_orbifold(turned, embedding.faces, tips)
    assert np.median(other.distortions(turned)) == pytest.approx(before, rel=0.02)


def test_any_cyclic_order_gives_the_same_distortion(
    embedded: tuple[np.ndarray, Embedding, list[int]],
) -> None:
    vertices, embedding, tips = embedded
    before = np.median(embedding.distortions(vertices))
    order = [tips[k] for k in (0, 2, 1, 3)]
    other = embed_orbifold(vertices, embedding.faces, order)
    assert np.median(other.distortions(vertices)) == pytest.approx(before, rel=0.05)


def test_the_tips_are_found_and_chosen() -> None:
    vertices, faces, tips = limbs()
    found = vertices[extremities(vertices, faces)]
    gap = np.linalg.norm(found[:, None] - vertices[tips][None], axis=2)
    assert gap.min(axis=0).max() < 0.5
    cones, table = choose_cones(vertices, faces)
    gap = np.linalg.norm(vertices[cones][:, None] - vertices[tips][None], axis=2)
    assert sorted(gap.argmin(axis=0).tolist()) == [0, 1, 2, 3] and gap.min(axis=0).max() < 0.5
    assert [s for s, _ in table] == sorted(s for s, _ in table)
    embedding = embed_orbifold(vertices, faces)
    assert embedding.cones is not None and set(embedding.cones.tolist()) == set(cones.tolist())
    assert embedding.certificate().injective and embedding.log


def test_a_large_mesh_is_drawn_together_once_for_its_cones_and_its_layout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    vertices, faces, _ = limbs()
    at_once = embed_orbifold(vertices, faces)
    monkeypatch.setattr(embedding_module, "LARGE", len(faces) // 2)
    found = embed_orbifold(vertices, faces)
    assert found.certificate().injective
    means = [np.log(e.distortions(vertices)).mean() for e in (at_once, found)]
    assert means[1] == pytest.approx(means[0], rel=0.05)


def test_all_orders_of_the_cones_without_another_solve(
    embedded: tuple[np.ndarray, Embedding, list[int]],
) -> None:
    vertices, embedding, tips = embedded
    before = np.sort(embedding.distortions(vertices))
    for order in permutations(tips):
        other = in_order(embedding, order)  # raises unless it is a homeomorphism
        np.testing.assert_array_equal(other.uv[list(order)], [[0, 0], [1, 0], [1, 1], [0, 1]])
        np.testing.assert_allclose(np.sort(other.distortions(vertices)), before, rtol=1e-6)
    with pytest.raises(NsmError) as error:
        in_order(embedding, [*tips[:3], 0])
    assert error.value.kind == "wrong_cones"


def test_twists_are_other_classes(embedded: tuple[np.ndarray, Embedding, list[int]]) -> None:
    vertices, embedding, tips = embedded
    for basis in ([[1, 2], [0, 1]], [[1, 0], [-2, 1]], [[5, 2], [2, 1]]):
        other = twisted(embedding, np.array(basis))
        assert other.certificate().injective
        np.testing.assert_array_equal(other.uv[tips], embedding.uv[tips])
        np.testing.assert_allclose(
            np.median(other.distortions(vertices)),
            np.median(embedding.distortions(vertices)),
            rtol=1e-6,
        )
        back = twisted(other, np.rint(np.linalg.inv(basis)).astype(int))
        np.testing.assert_allclose(back.lattice, embedding.lattice, atol=1e-9)
    with pytest.raises(NsmError) as error:
        twisted(embedding, np.array([[1, 1], [0, 1]]))
    assert error.value.kind == "out_of_range"


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_copies_lie_where_the_corners_do(
    embedded: tuple[np.ndarray, Embedding, list[int]], seed: int
) -> None:
    """In whatever layout: different lifts of a vertex are different copies."""
    rng = np.random.default_rng(seed)
    _, embedding, _ = embedded
    assert embedding.cones is not None
    embedding = in_order(embedding, rng.permutation(embedding.cones).tolist())
    for _ in range(rng.integers(4)):
        k = int(rng.choice([-2, 2]))
        embedding = twisted(embedding, np.array([[[1, k], [0, 1]], [[1, 0], [k, 1]]][k // 2]))
    origin, uv, faces = embedding.copies()
    np.testing.assert_allclose(uv[faces], embedding.corners(), atol=1e-12)
    np.testing.assert_array_equal(origin[faces], embedding.faces)
    np.testing.assert_array_equal(origin[: len(embedding.uv)], np.arange(len(embedding.uv)))
    assert len(np.unique(np.column_stack([origin, uv.round(9)]), axis=0)) == len(origin)


def test_what_is_broken_is_noticed(embedded: tuple[np.ndarray, Embedding, list[int]]) -> None:
    _, embedding, tips = embedded
    uv = embedding.uv.copy()
    uv[tips[1]] += 1e-9
    assert not embedding.certificate(uv).cones_held
    uv = embedding.uv.copy()
    inner = next(v for v in range(len(uv)) if v not in tips)
    uv[inner] += 0.5
    found = embedding.certificate(uv)
    assert found.flipped.any() and not found.injective
    lift = embedding.lift.copy()
    lift[0, 0, 1] += 1
    assert torn_edges(embedding.faces, lift, embedding.cones) > 0
    assert embedding.certificate(-embedding.uv).cones_held is False


def test_a_torus() -> None:
    vertices, faces = torus()
    embedding = embed_torus(vertices, faces)
    assert embedding.certificate().injective
    assert embedding.cones is None and (embedding.lift[:, :, 0] == 1).all()
    assert np.median(embedding.distortions(vertices)) < 6
    long, short = np.linalg.norm(embedding.lattice, axis=0)
    angle = embedding.lattice[:, 0] @ embedding.lattice[:, 1] / (long * short)
    assert abs(angle) <= 0.5 + 1e-9
    assert max(long, short) / min(long, short) == pytest.approx(2.5, rel=0.25)
    with pytest.raises(NsmError) as error:
        embed_orbifold(vertices, faces)
    assert error.value.kind == "wrong_topology"


@pytest.mark.parametrize("even", [False, True])
def test_reduced_bases(even: bool) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        lattice = rng.normal(size=(2, 2))
        basis = reduced_basis(lattice, even)
        assert round(np.linalg.det(basis)) == 1
        if even:
            np.testing.assert_array_equal(np.mod(basis, 2), np.eye(2))
        a, b = (lattice @ basis).T
        step = 2 if even else 1
        assert abs(a @ b) <= step * min(a @ a, b @ b) / 2 * (1 + 1e-9)
