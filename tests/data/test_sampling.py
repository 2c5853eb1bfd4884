"""Samples: uniform by area, on the surface, a function of (seed, step)."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples
from tiny import dome

from nsm.data import CollectionData, Sampler, SurfaceData, SurfaceSampler
from nsm.domains import Surface
from nsm.maps import Rotated
from nsm.surfaces.location import locate


def nearest(points, others):
    """Distance of each point to the nearest of the others, without cancellation."""
    exact = "donot_use_mm_for_euclid_dist"
    return torch.cdist(points, others, compute_mode=exact).min(dim=1).values


@pytest.fixture(scope="module")
def uneven() -> Surface:
    """A flat rectangle of two halves: one cut fine, one coarse."""
    fine = np.linspace(0, 1, 21)
    x = np.concatenate([fine, [1.5, 2.0]])
    y = np.linspace(0, 1, 11)
    gx, gy = np.meshgrid(x, y, indexing="ij")
    vertices = np.stack([gx.ravel(), gy.ravel(), np.zeros(gx.size)], axis=1)
    columns = len(y)
    a = (np.arange(len(x) - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([a, a + columns, a + columns + 1], axis=1),
            np.stack([a, a + columns + 1, a + 1], axis=1),
        ]
    )
    return Surface.from_arrays(vertices, faces, domain="square")


def test_uniform_by_area_not_by_face(uneven):
    sampler = SurfaceSampler(uneven)
    points = sampler.by_area(40_000, sampler.generator(0)).points
    # both halves have the same area, though one has ten times the faces
    share = float((points[:, 0] < 0).float().mean())
    assert share == pytest.approx(0.5, abs=0.01)


def test_a_share_uniform_in_the_domain_has_the_mixed_density(uneven):
    """Of a layout that gives three quarters of Ω to the left half of the rectangle."""
    x = uneven.vertices[:, 0] / uneven.vertices[:, 0].max()
    u = np.where(x < 0, 0.5 + 1.5 * x, 0.5 + 0.5 * x)
    surface = dataclasses.replace(uneven, uv=np.stack([u, uneven.vertices[:, 1]], axis=1))
    sampler = SurfaceSampler(surface)
    for share in (0.0, 0.4, 1.0):
        draws = Sampler(domain_share=share)
        points = draws.draw(sampler, 40_000, sampler.generator(0)).points
        left = float((points[:, 0] < 0).float().mean())
        assert left == pytest.approx(0.5 * (1 - share) + 0.75 * share, abs=0.01)


def test_samples_lie_on_the_surface_with_its_normals(uneven):
    sampler = SurfaceSampler(uneven)
    samples = Sampler(0.3).draw(sampler, 1000, sampler.generator(1))
    assert len(samples.uv) == len(samples.points) == len(samples.normals) == 1000
    assert torch.allclose(samples.points[:, 2], torch.tensor(0.0), atol=1e-6)
    assert torch.allclose(samples.normals.abs()[:, 2], torch.tensor(1.0), atol=1e-6)
    assert float(samples.uv.abs().max()) <= 1 + 1e-6
    # the last 300 are vertices
    assert float(nearest(samples.points[-300:], sampler.vertices).max()) < 1e-6


def test_uv_and_points_correspond(uneven):
    """The rectangle's map to its points is piecewise linear: barycentric weights must agree."""
    sampler = SurfaceSampler(uneven)
    samples = sampler.by_area(50, sampler.generator(2))
    for uv, point in zip(samples.uv.numpy(), samples.points.numpy(), strict=True):
        found = False
        for face in uneven.faces:
            t = np.vstack([uneven.uv[face].T, np.ones(3)])
            weights = np.linalg.solve(t, [*uv, 1.0])
            if (weights > -1e-4).all():
                found |= bool(np.allclose(weights @ uneven.vertices[face], point, atol=1e-4))
        assert found


def test_one_of_so_many_samples_is_on_the_boundary_by_length(uneven):
    sampler = SurfaceSampler(uneven)
    samples, jacobian = sampler.with_jacobian(60_000, 3, sampler.generator(4))
    half = sampler.vertices.amax(dim=0)[:2]  # the rectangle is twice as long as it is high
    at_side = (samples.points[:, :2].abs() - half).abs() < 1e-6  # at x = ±half, at y = ±half
    on_rim = at_side.any(dim=1)
    assert on_rim[::3].all() and on_rim.float().mean() == pytest.approx(1 / 3, abs=1e-3)
    assert at_side[::3, 1].float().mean() == pytest.approx(2 / 3, abs=0.01)
    left = samples.points[::3][at_side[::3, 1], 0] < 0
    assert left.float().mean() == pytest.approx(0.5, abs=0.01)
    # the map from Ω is affine on each triangle: from the boundary too it leads to the corners
    for k in (0, 3, 300, 301):
        ways = torch.as_tensor(uneven.uv, dtype=torch.float32) - samples.uv[k]
        reached = samples.points[k] + ways @ jacobian[k].t()
        met = (reached - sampler.vertices).norm(dim=1) < 1e-4
        assert any(met[list(face)].all() for face in uneven.faces)


def test_samples_of_a_fit_are_spread_over_the_faces_evenly_and_in_random_order(uneven):
    boundary_every = 1 << 30  # the first alone
    sampler = SurfaceSampler(uneven)
    count = 2000
    uv = sampler.with_jacobian(count, boundary_every, sampler.generator(4))[0].uv[1:].numpy()
    inside = uneven.domain.locate(uv, uneven.uv, uneven.faces).face
    wanted = count * sampler.cumulative_area.diff(prepend=torch.zeros(1, dtype=torch.float64))
    met = np.bincount(inside, minlength=len(uneven.faces))
    # each part of equal area has its point: only the first and last of a face's may be another's
    assert np.abs(met - wanted.numpy()).max() <= 3
    half = np.bincount(inside[: count // 2], minlength=len(uneven.faces))
    assert np.abs(half - wanted.numpy() / 2).max() < 4 * np.sqrt(wanted.max())


def test_jacobians_are_finite_where_single_precision_loses_a_triangle(uneven):
    uv = uneven.uv.copy()
    uv[uneven.faces[0]] = uv[uneven.faces[0, 0]] + np.array([[0, 0], [1e-12, 0], [0, 1e-12]])
    sampler = SurfaceSampler(dataclasses.replace(uneven, uv=uv))
    jacobian = sampler.with_jacobian(20_000, 3, sampler.generator(0))[1]
    assert torch.isfinite(jacobian).all()
    assert (jacobian == 0).flatten(1).all(dim=1).any()


def test_a_batch_depends_on_seed_and_step_alone(uneven):
    first, again = (SurfaceData(uneven, batch_size=64, seed=3) for _ in range(2))
    first.setup()
    again.setup()
    first.batch(0)
    assert torch.equal(first.batch(7).points, again.batch(7).points)
    assert not torch.equal(first.batch(7).points, first.batch(8).points)
    other = SurfaceData(uneven, batch_size=64, seed=4)
    other.setup()
    assert not torch.equal(first.batch(7).points, other.batch(7).points)


def test_pool_holds_every_vertex(uneven):
    data = SurfaceData(uneven, Sampler(pool=1000), batch_size=64)
    data.setup()
    pool = data.own_sampler.fixed
    assert len(pool.points) == 1000
    assert float(nearest(data.points.vertices, pool.points).max()) < 1e-6
    batch = data.batch(0)
    assert float(nearest(batch.points, pool.points).max()) < 1e-6


def test_batches_come_again(uneven):
    data = SurfaceData(
        uneven, Sampler(batches=3, stratified=True), batch_size=50, steps_per_epoch=10
    )
    data.setup()
    drawn = [data.batch(step) for step in range(40)]
    distinct = {tuple(batch.uv[0].tolist()): batch for batch in drawn}
    assert len(distinct) == 3
    again = SurfaceData(
        uneven, Sampler(batches=3, stratified=True), batch_size=50, steps_per_epoch=10
    )
    again.setup()
    # a training that goes on from step 30 meets what the whole one met there
    assert all(torch.equal(again.batch(step).points, drawn[step].points) for step in range(30, 40))


def test_every_batch_can_have_all_vertices(uneven):
    data = SurfaceData(uneven, Sampler(pool=1000, every_vertex=True), batch_size=64)
    data.setup()
    count, pool = len(uneven.vertices), data.own_sampler.fixed
    assert len(pool.points) == 1000  # of the surface alone
    assert float(nearest(pool.points, data.points.vertices).max()) > 1e-3
    for step in (0, 1):
        batch = data.batch(step)
        assert len(batch.uv) == 64 + count
        assert torch.equal(batch.points[64:], data.points.vertices)
        assert float(nearest(batch.points[:64], pool.points).max()) == 0
    assert not torch.equal(data.batch(0).points[:64], data.batch(1).points[:64])


def test_held_out_points_are_not_trained_on(uneven):
    data = SurfaceData(uneven, batch_size=512, held_out=512)
    data.setup()
    held_out = torch.cat([chunk.uv for chunk in data.val_dataloader()])
    assert len(held_out) == 512
    for step in range(3):
        assert float(nearest(held_out, data.batch(step).uv).min()) > 0


DOME = dome(0.5, 3)


@examples(20)
@given(st.integers(0, 200), st.floats(0, 1), st.integers(0, 2**62), st.integers(0, 10**9))
def test_any_draw_lies_on_the_surface_and_comes_again(count, share, seed, step):
    sampler = SurfaceSampler(DOME)
    draws = Sampler(share)
    samples = draws.draw(sampler, count, sampler.generator(seed, step))
    assert [len(part) for part in samples] == [count] * 3
    assert all(part.isfinite().all() for part in samples)
    assert (samples.uv.norm(dim=1) <= 1 + 1e-6).all()
    assert torch.allclose(samples.normals.norm(dim=1), torch.ones(count), atol=1e-5)
    places = locate(samples.uv.double().numpy(), DOME.uv, DOME.faces)
    there = places.take(DOME.vertices, DOME.faces)
    assert np.allclose(there, samples.points.numpy(), atol=1e-5)
    again = draws.draw(sampler, count, sampler.generator(seed, step))
    assert all(torch.equal(a, b) for a, b in zip(samples, again, strict=True))


class Corners:
    """A user's own sampler: the first vertices, in turn."""

    def draw(self, surface, count, generator):
        return surface.at_vertices(torch.arange(count) % len(surface.vertices))


def test_a_users_own_sampler_needs_one_method():
    data = SurfaceData(DOME, Corners(), batch_size=8)
    data.setup()
    assert torch.equal(data.batch(3).points, data.points.vertices[:8])
    shared = CollectionData(
        [DOME] * 3,
        [Rotated(torch.nn.Identity(), torch.eye(2))] * 3,
        Corners(),
        batch_size=9,
        steps_per_epoch=1,
        held_out=9,
    )
    shared.setup()
    assert torch.equal(shared.batch(0), data.points.uv[:3].repeat(3, 1))


@pytest.mark.parametrize(
    "settings", [{"vertex_share": 1.5}, {"pool": 0}, {"domain_share": -1}, {"batches": 0}]
)
def test_a_sampler_refuses_shares_that_are_none(settings):
    with pytest.raises(ValueError):
        Sampler(**settings)
    with pytest.raises(ValueError):
        Sampler(vertex_share=0.6, domain_share=0.6)
