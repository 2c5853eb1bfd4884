"""Quasi-Newton steps: curvature, levels that are subspaces, descent, and resumption."""

import copy

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix, identity
from scipy.sparse.linalg import splu

from nsm.errors import NsmError
from nsm.maps import DiscMap, LatticeAligned, NeuralMap, PlanarMap, SplineField, TorusMap
from nsm.tasks.curvature import Curvature, positive_hessians
from nsm.tasks.optimizers import build_optimizer
from nsm.tasks.quasi_newton import QuasiNewton
from nsm.tasks.spline_level import Level, Metric

SETTINGS = {
    "_target_": "nsm.tasks.quasi_newton.QuasiNewton",
    "levels": [4, 8],
    "steps": [2],
    "iterations": 5,
    "smoothing": 0.0,
}


KINDS = [(False, False), (True, False), (True, True)]  # periodic, odd


def filled(cells, periodic, odd, out_dim=2):
    """A double-precision spline with random coefficients."""
    field = SplineField(out_dim, cells, periodic, odd).double()
    with torch.no_grad():
        field.coefficients.normal_(generator=torch.Generator().manual_seed(cells))
    return field


def points(count=300):
    return 2 * torch.rand(count, 2, generator=torch.Generator().manual_seed(1)).double() - 1


def whole(level, entries):
    """A matrix from its entries in a level's pattern."""
    return csr_matrix((entries, level.pattern.indices, level.pattern.indptr), level.pattern.shape)


@pytest.mark.parametrize("periodic, odd", KINDS)
def test_a_level_is_the_same_spline_on_the_fine_grid(periodic, odd):
    coarse, fine = filled(6, periodic, odd), filled(24, periodic, odd)
    level = Level(fine, 6)
    c = coarse.coefficients.detach().numpy()
    with torch.no_grad():
        fine.coefficients.copy_(torch.from_numpy(level.up @ c))
    x = points()
    torch.testing.assert_close(fine(x), coarse(x))
    np.testing.assert_allclose(level.restored(fine.coefficients), c, atol=1e-9)


@pytest.mark.parametrize("periodic, odd", KINDS)
def test_smoothness_is_the_mean_squared_change_of_slopes_over_a_cell(periodic, odd):
    cells = 24
    field = SplineField(1, cells, periodic, odd).double()
    # a spline near to sin(πu) + ½ sin(πv), whose second derivatives are known
    side = torch.arange(field.side).double()
    at = -1 + (side + (0.5 if periodic else -0.5)) * (2 / cells)
    wave = (torch.pi * at).sin()
    table = (wave[:, None] + 0.5 * wave).flatten()
    c = table[: len(field.coefficients)].numpy()[:, None]
    expected = (2 / cells) ** 2 * torch.pi**4 * 0.5 * (1 + 0.25)
    found = float((c * (Level(field, cells).smoothness @ c)).sum())
    assert found == pytest.approx(expected, rel=0.12)


@pytest.mark.parametrize("cells", [4, 8])  # of 4, points see some coefficients twice
@pytest.mark.parametrize("periodic, odd", KINDS)
def test_a_levels_matrices_are_quadratic_forms_of_what_points_see(cells, periodic, odd):
    field = filled(cells, periodic, odd)
    x = points(40)
    half = torch.randn(2, 40, 3, 3, dtype=torch.float64)
    blocks = half @ half.mT
    level = Level(field, cells)
    found = [whole(level, entries) for entries in level.matrices(x, blocks)]
    value, jacobian = field.value_and_jacobian(x)
    seen = torch.cat([value[..., None], jacobian], dim=-1)  # (N, 2, 3)
    c = field.coefficients.detach().numpy()
    for k, matrix in enumerate(found):
        expected = torch.einsum("np,npq,nq->", seen[:, k], blocks[k], seen[:, k]).detach()
        assert c[:, k] @ (matrix @ c[:, k]) == pytest.approx(float(expected), rel=1e-9)
        assert abs(matrix - matrix.T).max() < 1e-9


@pytest.mark.parametrize("periodic, odd", KINDS)
def test_a_regularizer_is_of_floor_and_smoothness(periodic, odd):
    level = Level(SplineField(1, 6, periodic, odd), 6)
    found = whole(level, level.regularizer(0.5))
    assert abs(found - level.floor - level.smoothness).max() < 1e-12


@pytest.mark.parametrize("cells", [4, 6, 22])
@pytest.mark.parametrize("periodic, odd", KINDS)
def test_a_metric_solves_each_component(cells, periodic, odd):
    level = Level(SplineField(2, cells, periodic, odd), cells)
    half = torch.randn(2, 500, 3, 3, dtype=torch.float64)
    entries = level.regularizer(0.1) + level.matrices(points(500), half @ half.mT)
    right = np.random.default_rng(0).standard_normal((level.rows, 2))
    solved = Metric(level, entries).solve(right)
    for k in range(2):
        expected = splu(whole(level, entries[k]).tocsc()).solve(right[:, k])
        np.testing.assert_allclose(solved[:, k], expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("odd", [False, True])
def test_factors_in_a_levels_order_are_smaller_than_by_minimum_degree(odd):
    level = Level(SplineField(1, 64, periodic=odd, odd=odd), 64)
    matrix = whole(level, np.random.default_rng(0).random(level.pattern.nnz) * 1e-3)
    matrix = (matrix + matrix.T + identity(level.rows)).tocsc()
    order = level.elimination.order
    options = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    least = splu(matrix, permc_spec="MMD_AT_PLUS_A", **options).L.nnz
    assert splu(matrix[order][:, order], permc_spec="NATURAL", **options).L.nnz < least


def test_an_odd_spline_is_odd_and_periodic():
    field, x = filled(8, True, True), points(50)
    torch.testing.assert_close(field(-x), -field(x))
    torch.testing.assert_close(field(x + torch.tensor([2.0, -4.0])), field(x))
    for cells, periodic in ((7, True), (8, False)):
        with pytest.raises(ValueError, match="odd"):
            SplineField(2, cells, periodic, odd=True)


def test_positive_hessians_are_those_of_a_convex_function():
    form = torch.randn(4, 4, dtype=torch.float64)
    form = form @ form.T
    j = torch.randn(6, 2, 2, dtype=torch.float64)

    def convex(at):
        return 0.5 * torch.einsum("np,pq,nq->n", at.flatten(1), form, at.flatten(1))

    torch.testing.assert_close(positive_hessians(convex, j), form.expand(6, 4, 4))
    # the determinant has eigenvalues 1, 1, -1, -1: half of them are left
    values = torch.linalg.eigvalsh(positive_hessians(torch.linalg.det, j))
    torch.testing.assert_close(values, torch.tensor([0.0, 0, 1, 1]).double().expand(6, 4))


@pytest.mark.parametrize("kind", ["plane", "disc", "lattice"])
@pytest.mark.parametrize("entries", [2, 4])
def test_curvature_is_the_second_difference_along_the_spline(kind, entries):
    made = {
        "plane": lambda: PlanarMap(SplineField(2, 8)),
        "disc": lambda: DiscMap(SplineField(3, 8)),
        "lattice": lambda: LatticeAligned(
            TorusMap(SplineField(2, 8, True, True)),
            torch.tensor([[1.0, 2.0], [0.0, 1.0]]),
            torch.tensor([1.0, 0.0]),
        ),
    }
    h = made[kind]().double()
    [c] = h.parameters()
    x = 0.6 * points(30)
    with torch.no_grad():
        c.copy_(0.1 * torch.randn(c.shape, dtype=torch.float64))
    half = torch.randn(30, entries, entries, dtype=torch.float64)
    hessians = half @ half.mT
    field, at, blocks = Curvature(h, x, hessians).of_field()
    level = Level(field, 8)
    matrices = [whole(level, entries) for entries in level.matrices(at, blocks)]

    def seen(shift):
        with torch.no_grad():
            before = c.clone()
            c.add_(shift)
            value, jacobian = h.value_and_jacobian(x)
            c.copy_(before)
        return value if entries == 2 else jacobian.flatten(1)

    for k, matrix in enumerate(matrices):
        d = torch.zeros_like(c)
        d[:, k] = torch.randn(len(c), dtype=torch.float64)
        change = (seen(1e-5 * d) - seen(-1e-5 * d)) / 2e-5
        expected = torch.einsum("np,npq,nq->", change, hessians, change)
        found = d[:, k].numpy() @ (matrix @ d[:, k].numpy())
        assert found == pytest.approx(float(expected), rel=1e-5)


def test_a_level_must_fit_the_field():
    with pytest.raises(ValueError, match="power of two"):
        Level(SplineField(2, 12), 5)


def test_only_splines_are_trained():
    with pytest.raises(NsmError) as caught:
        build_optimizer(NeuralMap(out_dim=2, width=4, depth=1), SETTINGS)
    assert caught.value.kind == "unsuitable_network"
    with pytest.raises(NsmError) as caught:
        build_optimizer(SplineField(2, 8), {**SETTINGS, "steps": [1, 1]})
    assert caught.value.kind == "not_instantiable"


def problem():
    """A disc map that should become a rotation with a swirl, and the closure of its loss."""
    h = DiscMap(SplineField(3, 8))
    g = torch.Generator().manual_seed(0)
    x = torch.rand(400, 2, generator=g) * 1.2 - 0.6
    angle = 0.4 + 0.5 * (x**2).sum(dim=1)
    c, s = angle.cos(), angle.sin()
    wanted = torch.stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1]], dim=1)

    def made(optimizer):
        def closure():
            optimizer.zero_grad()
            value, jacobian = h.value_and_jacobian(x)
            loss = ((value - wanted) ** 2).sum(dim=1).mean() + 1e-6 * (jacobian**2).mean()
            loss.backward()
            return loss.detach()

        return closure

    return h, made


def test_the_loss_only_decreases_and_far():
    h, made = problem()
    optimizer = build_optimizer(h, SETTINGS)
    closure = made(optimizer)
    losses = [float(optimizer.step(closure)) for _ in range(8)]
    assert all(after <= before for before, after in zip(losses, losses[1:], strict=False))
    assert losses[-1] < 1e-2 * losses[0] or losses[-1] < 1e-5


def test_a_coarse_level_stays_in_its_subspace():
    h, made = problem()
    optimizer = build_optimizer(h, SETTINGS)
    optimizer.step(made(optimizer))
    c = h.network.coefficients.detach()
    level = Level(h.network, 4)
    basis = torch.as_tensor(level.up.toarray(), dtype=torch.float32)
    fitted = basis @ torch.linalg.lstsq(basis, c).solution
    torch.testing.assert_close(fitted, c, atol=1e-5, rtol=0)
    assert float(c.abs().max()) > 1e-2


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_stored_and_loaded_it_goes_on_bit_for_bit(steps):
    h, made = problem()
    optimizer = build_optimizer(h, SETTINGS)
    for _ in range(steps):
        optimizer.step(made(optimizer))
    weights, state = copy.deepcopy(h.state_dict()), copy.deepcopy(optimizer.state_dict())
    for _ in range(3):
        optimizer.step(made(optimizer))
    again, other = problem()
    again.load_state_dict(weights)
    resumed = build_optimizer(again, SETTINGS)
    resumed.load_state_dict(state)
    for _ in range(3):
        resumed.step(other(resumed))
    assert torch.equal(again.network.coefficients, h.network.coefficients)


def test_known_curvature_reaches_a_quadratic_minimum_at_once():
    h = PlanarMap(SplineField(2, 8))
    optimizer = QuasiNewton(
        [h.network.coefficients], [h.network], levels=[8], steps=[], iterations=3, smoothing=0.0
    )
    x = points(400).float()
    wanted = x + 0.1 * torch.sin(3 * x.flip(1))
    identity = torch.eye(2).expand(400, 2, 2) * (2 / 400)
    optimizer.watch(lambda: [Curvature(h, x, identity)], lambda: [h])

    def closure():
        optimizer.zero_grad()
        loss = ((h(x) - wanted) ** 2).sum(dim=1).mean()
        loss.backward()
        return loss.detach()

    first = float(closure())
    assert float(optimizer.step(closure)) < 1e-3 * first


def wave(iterations):
    """Steps, each of some iterations, to a map whose curvature is known, with little to gain."""
    h = PlanarMap(SplineField(2, 8))
    optimizer = QuasiNewton(
        [h.network.coefficients], [h.network], [8], [], iterations=iterations, smoothing=0.0
    )
    x = points(400).float()
    wanted = x + 0.2 * torch.sin(3 * x.flip(1))
    # not the curvature, so that the iterations have something to learn
    known = torch.eye(2).expand(400, 2, 2) * (8 / 400) * (1.5 + x[:, :1, None])
    seen = []
    optimizer.watch(lambda: seen.append(1) or [Curvature(h, x, known)], lambda: [h])

    def step():
        def closure():
            optimizer.zero_grad()
            loss = 1 + ((h(x) - wanted) ** 2).sum(dim=1).mean()
            loss.backward()
            return loss.detach()

        return float(optimizer.step(closure))

    return h, optimizer, step, seen


def test_steps_of_little_gain_go_on_as_one_longer_step():
    whole, _, step, seen = wave(6)
    step()
    parts, _, short, looked = wave(2)
    for _ in range(3):
        short()
    # a step begins with coefficients in single precision
    torch.testing.assert_close(
        parts.network.coefficients, whole.network.coefficients, rtol=1e-3, atol=1e-6
    )
    assert len(seen) == len(looked) == 1


def test_a_step_begins_anew_when_told_to():
    h, optimizer, step, seen = wave(2)
    step()
    assert optimizer.state_dict()["known"] is not None
    optimizer.begin_anew()
    assert optimizer.state_dict()["known"] is None
    step()
    assert len(seen) == 2


def test_what_is_released_is_made_again():
    ends = []
    for let_go in (QuasiNewton.begin_anew, QuasiNewton.release):
        h, optimizer, step, seen = wave(2)
        step()
        let_go(optimizer)
        step()
        assert len(seen) == 2
        ends.append(h.network.coefficients)
    assert torch.equal(*ends)


def test_what_is_known_of_the_curvature_is_stored():
    whole, optimizer, step, _ = wave(2)
    step()
    kept = copy.deepcopy((whole.state_dict(), optimizer.state_dict()))
    resumed, other, again, seen = wave(2)
    resumed.load_state_dict(kept[0])
    other.load_state_dict(kept[1])
    assert other.state_dict()["known"] is kept[1]["known"]  # until a step takes it
    for _ in range(2):
        step()
        again()
    assert torch.equal(resumed.network.coefficients, whole.network.coefficients)
    assert not seen


def test_a_step_that_was_rolled_back_ends():
    f = SplineField(2, 8)
    optimizer = build_optimizer(f, SETTINGS)

    def closure():
        f.coefficients.grad = None
        return torch.tensor(float("nan"))

    assert optimizer.step(closure) is None
    assert not f.coefficients.detach().any()


def test_a_further_training_is_on_the_finest_level():
    f = SplineField(2, 8)
    with torch.no_grad():
        f.coefficients.fill_(0.1)
    optimizer = build_optimizer(f, SETTINGS)
    assert optimizer.state[f.coefficients]["step"] == sum(SETTINGS["steps"])


def test_parts_take_turns_while_the_rest_is_held():
    maps = torch.nn.ModuleList(PlanarMap(SplineField(2, 8)) for _ in range(2))
    fields = [h.network for h in maps]
    optimizer = QuasiNewton(
        [f.coefficients for f in fields], fields, [8], [], iterations=3, smoothing=0.0
    )
    x, seen = points(400).float(), []

    def turns():
        for n, h in enumerate(maps):
            seen.append([f.coefficients.detach().clone() for f in fields])
            optimizer.number = n
            yield h

    def closure():
        optimizer.zero_grad()
        wanted = x + 0.1 * torch.sin(3 * x.flip(1))
        loss = sum(((h(x) - wanted) ** 2).sum(dim=1).mean() for h in maps)
        loss.backward()
        return loss.detach()

    identity = torch.eye(2).expand(400, 2, 2) * (2 / 400)
    optimizer.watch(lambda: [Curvature(maps[optimizer.number], x, identity)], turns)
    optimizer.step(closure)
    (first, held), (moved, still) = seen
    assert not held.any() and not still.any() and moved.any() and not first.any()
    torch.testing.assert_close(fields[1].coefficients, fields[0].coefficients)
