"""Short trainings: sines with the symmetries of Ω, energies against closed forms, descent."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from thorough import examples

from nsm.correspondence import refinement
from nsm.correspondence.compiled_energies import Energies
from nsm.correspondence.layouts import _logarithm
from nsm.correspondence.refinement import (
    Anchors,
    Batch,
    Sines,
    _exponential,
    refined,
)

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1, 1, (200, 2))


def flat(tables, matrices, shifts, largest=2, metric=None, **more):
    """A batch whose source is the plane: the unit square metric at random points."""
    count = len(POINTS)
    inverse = np.tile(np.eye(2) if metric is None else np.linalg.inv(metric), (count, 1, 1))
    source = SimpleNamespace(at=POINTS, inverse=inverse, area=np.full(count, 1 / count))
    return Batch(
        [source],
        [len(matrices)],
        [SimpleNamespace(log_metric=t) for t in tables],
        np.arange(len(matrices)) % len(tables),
        np.array(matrices),
        np.array(shifts),
        largest,
        **more,
    )


def constant(metric, cells=8):
    return np.broadcast_to(_logarithm(metric[None])[0], (cells, cells, 3)).copy()


def symmetric_dirichlet(jacobian, epsilon=0.01):
    m = jacobian.T @ jacobian
    return np.trace(m) + np.trace(np.linalg.inv(m + epsilon * np.eye(2)))


@given(st.integers(0, 4), st.integers(-3, 3), st.integers(-3, 3))
@examples(20)
def test_displacements_have_the_symmetries_of_the_orbifold(largest, m, n):
    sines = Sines.up_to(largest)
    assert len(sines.waves) == ((2 * largest + 1) ** 2 - 1) // 2
    value = sines.basis(POINTS)[0]
    assert np.allclose(sines.basis(-POINTS)[0], -value)
    assert np.allclose(sines.basis(POINTS + 2 * np.array([m, n]))[0], value)
    # a finer set begins with a coarser one
    assert np.array_equal(Sines.up_to(largest + 1).waves[: len(sines.waves)], sines.waves)


def test_derivatives_of_the_sines():
    sines, step = Sines.up_to(3), 1e-6
    basis = sines.basis(POINTS)
    for axis in (0, 1):
        move = step * np.eye(2)[axis]
        difference = sines.basis(POINTS + move)[0] - sines.basis(POINTS - move)[0]
        assert basis[1 + axis] == pytest.approx(difference / (2 * step), abs=1e-6)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2))
@examples(30)
def test_exponentials_and_logarithms(m, a, b):
    matrix = expm(np.array([[m + a, b], [b, m - a]]))
    size, even, odd = (f.item() for f in _exponential(*torch.tensor([m, a, b]).double()))
    made = even * np.eye(2) + odd * np.array([[a, b], [b, -a]])
    assert made == pytest.approx(matrix, rel=1e-6)
    assert size**2 == pytest.approx(np.linalg.det(matrix))
    assert _logarithm(matrix[None])[0] == pytest.approx([m, a, b], abs=1e-9)


@pytest.mark.parametrize("matrix", [((1, 0), (0, 1)), ((1, 1), (0, 1)), ((0, -1), (1, 2))])
def test_the_energy_of_an_affine_map(matrix):
    source, target = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[1.0, -0.4], [-0.4, 1.5]])
    batch = flat([constant(target)], [matrix], [(1, 0)], metric=source)
    found = batch.energies(torch.zeros(1, 12, 2)).item()
    # both metrics are those of linear maps of the plane
    a, b = np.linalg.cholesky(source).T, np.linalg.cholesky(target).T
    expected = symmetric_dirichlet(b @ np.array(matrix) @ np.linalg.inv(a))
    assert found == pytest.approx(expected, rel=1e-5)


def test_the_energy_of_a_map_that_is_not_affine():
    """Against the map's Jacobians by finite differences, and the table's function itself."""
    cells = 256
    line = 2 * np.arange(cells) / cells
    x, y = np.meshgrid(line, line, indexing="ij")

    def log_metric(points):
        u = np.cos(np.pi * points[..., 0]) * np.cos(np.pi * points[..., 1])
        return np.stack([0.2 * u, 0.3 * u, -0.1 * u], axis=-1)

    batch = flat([log_metric(np.stack([x, y], axis=-1))], [((1, 1), (0, 1))], [(1, 1)])
    sines = Sines.up_to(2)
    amplitudes = 0.05 * RNG.normal(size=(12, 2))

    def image(points):
        moved = points + sines.basis(points)[0] @ amplitudes
        return moved @ np.array([[1, 1], [0, 1]]).T + 1

    energy, step = 0.0, 1e-6
    for p in POINTS:
        moves = [(image((p + e)[None]) - image((p - e)[None]))[0] for e in step * np.eye(2)]
        jacobian = np.stack(moves, axis=1) / (2 * step)
        m, a, b = log_metric(image(p[None])[0])
        root = np.linalg.cholesky(expm(np.array([[m + a, b], [b, m - a]]))).T
        energy += symmetric_dirichlet(root @ jacobian) / len(POINTS)
    found = batch.energies(torch.as_tensor(amplitudes[None], dtype=torch.float32)).item()
    assert found == pytest.approx(energy, rel=1e-3)


def varied(*, targets=2, maps=4, scale=0.3):
    """A batch of maps to rough targets, some of them folded, and amplitudes (H, 12, 2)."""
    rng = np.random.default_rng(1)
    tables = [0.3 * rng.normal(size=(8, 8, 3)) for _ in range(targets)]
    matrices = [((1, 0), (0, 1)), ((1, 1), (0, 1)), ((0, -1), (1, 0)), ((1, 0), (1, 1))][:maps]
    batch = flat(tables, matrices, [(k, 1) for k in range(maps)])
    return batch, torch.as_tensor(scale * rng.normal(size=(maps, 12, 2))).float()


@pytest.mark.parametrize("scale", [0.02, 0.3])
def test_compiled_energies_are_as_plain(scale, monkeypatch):
    batch, amplitudes = varied(scale=scale)
    found = []
    for compiled in (True, False):
        if not compiled:
            monkeypatch.setattr(refinement, "suit_compiled", lambda *_: False)
        x = amplitudes.clone().requires_grad_()
        energies = batch.energies(x)
        (energies * torch.arange(1.0, 5.0)).sum().backward()
        found.append((energies.detach(), x.grad))
    for one, other in zip(*found, strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-4 * float(other.abs().max()))


def test_gradients_of_compiled_energies_are_finite_differences():
    """In double precision, which the loops take too; some triangles are folded, some far above
    the energy that counts in full."""
    rng = np.random.default_rng(2)
    h = torch.as_tensor(np.stack([rng.normal(size=(2, 3, 9)), rng.normal(size=(2, 3, 9))]))
    number, bilinear = torch.tensor([0, 1]), torch.as_tensor(0.3 * rng.normal(size=(2, 4, 4, 4, 3)))
    scale, area = torch.as_tensor(rng.uniform(0.5, 2, (2, 9))), torch.as_tensor(rng.uniform(size=9))
    limits = 0.01, 0.1, 50.0

    def energies(x):
        return Energies.apply(x, number, bilinear, 1 / scale, scale, area, limits)

    folded = h[0, :, 1] * h[1, :, 2] - h[0, :, 2] * h[1, :, 1] < 0
    assert folded.any() and not folded.all()
    assert torch.autograd.gradcheck(energies, h.requires_grad_(), eps=1e-7, rtol=1e-4)


def test_layouts_of_one_shape_in_one_batch_are_as_one_by_one():
    one, amplitudes = varied()
    first = SimpleNamespace(at=POINTS, inverse=np.tile(np.eye(2), (len(POINTS), 1, 1)), area=None)
    first.area = np.full(len(POINTS), 1 / len(POINTS))
    second = SimpleNamespace(at=POINTS[::-1], inverse=2 * first.inverse, area=first.area)
    tables = [SimpleNamespace(log_metric=one.bilinear[k, :, :, 0].numpy()) for k in range(2)]
    matrix, shift, number = np.eye(2)[None], np.zeros((1, 2)), np.zeros(1, dtype=int)
    both = Batch(
        [first, second],
        [1, 2],
        tables,
        np.array([0, 1, 0]),
        np.repeat(matrix, 3, axis=0),
        np.repeat(shift, 3, axis=0),
        2,
    )
    alone = [
        Batch([source], [1], [tables[k]], number, matrix, shift, 2)
        for source, k in ((first, 0), (second, 1), (second, 0))
    ]
    x = 0.1 * amplitudes[:3]
    expected = [b.energies(x[k : k + 1])[0] for k, b in enumerate(alone)]
    assert torch.allclose(both.energies(x), torch.stack(expected), rtol=1e-5)
    assert len({round(float(e), 3) for e in expected}) == 3


def test_training_finds_the_isometry():
    """Each map of a batch goes down on its own; the least energy of all is that of isometries."""
    torch.manual_seed(0)
    turn = ((0, -1), (1, 0))
    batch = flat([constant(np.eye(2))], [((1, 0), (0, 1)), turn, ((1, 2), (0, 1))], [(0, 0)] * 3)
    start = 0.1 * torch.randn(3, 12, 2)
    before = batch.energies(start)
    amplitudes, energies = refined(batch, start, 80)
    assert (energies < before).all()
    assert torch.allclose(batch.energies(amplitudes), energies, rtol=1e-4)
    least = symmetric_dirichlet(np.eye(2))
    assert energies[:2].numpy() == pytest.approx([least, least], abs=0.02)
    # the other isotopy class holds no isometry
    assert energies[2] > 2 * least


def test_anchors_are_drawn_to_the_nearest_of_all_lifts():
    """Against all lifts of the place in a large window."""
    matrix, shift = np.array([[1, 1], [0, 1]]), np.array([1, 0])
    shape = np.array([[1.2, 0.3], [0.0, 0.8]])
    points, places = RNG.uniform(-1, 1, (5, 2)), RNG.uniform(-1, 1, (5, 2))
    weights = np.array([7.0, 1.0, 0.0, 3.0, 2.0])
    entries = (points[None], places[None], shape[None], weights[None])
    anchors = Anchors(*(torch.as_tensor(a).float() for a in entries))
    batch = flat([constant(np.eye(2))], [matrix], [shift], anchors=anchors)
    amplitudes = 0.1 * RNG.normal(size=(12, 2))
    image = (points + Sines.up_to(2).basis(points)[0] @ amplitudes) @ matrix.T + shift
    window = 2 * np.stack(np.meshgrid(*[np.arange(-6, 7)] * 2), axis=-1).reshape(-1, 2)
    lifts = np.concatenate([places[:, None] + window, window - places[:, None]], axis=1)
    flat_off = np.rint((image[:, None] - lifts) / 1e-12) * 1e-12
    coordinates = np.abs(flat_off).max(axis=2) <= 1  # nearest in coordinates, then in the plane
    squared = ((flat_off @ shape.T) ** 2).sum(axis=2)
    expected = np.where(coordinates, squared, np.inf).min(axis=1)
    given_ = torch.as_tensor(amplitudes[None], dtype=torch.float32)
    assert batch.gaps(given_, anchors)[0].numpy() == pytest.approx(expected, rel=1e-4)
    added = (batch.losses(given_) - batch.energies(given_)).item()
    assert added == pytest.approx(weights @ expected, rel=1e-3)
    drawn, _ = refined(batch, torch.zeros(1, 12, 2), 100)
    start = torch.zeros(1, 12, 2)
    gap = [(anchors.weights * batch.gaps(x, anchors)).sum() for x in (drawn, start)]
    assert gap[0] < 0.5 * gap[1]
