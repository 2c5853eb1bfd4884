"""Compiled reading of B-splines: the same as plain operations, and as finite differences."""

import pytest
import torch

from nsm.maps import LatticeSplineGrid, SplineField, SplineGrid
from nsm.maps.bsplines import read, read_plainly, seen
from nsm.tensors import suit_compiled


def clamped(degree):
    return SplineGrid(2, [5, 9], 3, degree)


KINDS = {
    "clamped": lambda: clamped(2),
    "cubic": lambda: clamped(3),
    "periodic": lambda: LatticeSplineGrid([(4, 6), (10, 8)], 3),
    "even": lambda: LatticeSplineGrid([(4, 6), (10, 8)], 2, even=True),
    "field": lambda: SplineField(2, 6),
    "periodic field": lambda: SplineField(2, 6, periodic=True),
    "odd": lambda: SplineField(2, 6, periodic=True, odd=True),
}


def made(kind, dtype=torch.float64):
    torch.manual_seed(1)
    grid = KINDS[kind]().to(dtype)
    tables = [torch.randn_like(p).requires_grad_() for p in grid.parameters()]
    return grid, list(grid.grids), tables


def points(count=60, reach=1.4, dtype=torch.float64):
    return (reach * (2 * torch.rand(count, 2, dtype=torch.float64) - 1)).to(dtype)


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_gradients_are_those_of_plain_operations(kind):
    _, grids, tables = made(kind)
    for tangents in (False, True):
        x, y = (points().requires_grad_() for _ in range(2))
        y.data = x.data.clone()
        found, plain = read(x, grids, tables, tangents), read_plainly(y, grids, tables, tangents)
        torch.testing.assert_close(found, plain)
        given = torch.randn_like(plain)
        for by, same in zip(
            torch.autograd.grad((given * found).sum(), [x, *tables]),
            torch.autograd.grad((given * plain).sum(), [y, *tables]),
            strict=True,
        ):
            torch.testing.assert_close(by, same)


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_differences(kind):
    _, grids, tables = made(kind)
    x = points(8, reach=0.9).requires_grad_()
    for tangents in (False, True):
        torch.autograd.gradcheck(
            lambda x, *t, tangents=tangents: read(x, grids, t, tangents), (x, *tables)
        )


@pytest.mark.parametrize("kind", ["periodic", "even", "periodic field", "odd"])
def test_far_lifts_of_a_point_agree(kind):
    _, grids, tables = made(kind)
    x = points()
    far = x + torch.tensor([2.0e3, -4.0e3], dtype=x.dtype)
    torch.testing.assert_close(read(far, grids, tables, True), read(x, grids, tables, True))
    if kind in ("even", "odd"):
        sign = 1 if kind == "even" else -1
        turned = read(-x, grids, tables, False)
        torch.testing.assert_close(turned, sign * read(x, grids, tables, False))


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_are_not_finite_read_nothing_beyond_the_table(kind):
    _, grids, tables = made(kind)
    x = torch.tensor([[torch.nan, 0.0], [torch.inf, -torch.inf], [1e30, -1e30], [0.1, 0.2]])
    values = read(x.double(), grids, tables, True)
    assert values[:, 0].isnan().any()
    assert values[:, 3].isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_what_points_see(kind):
    _, grids, tables = made(kind)
    for grid, table in zip(grids, tables, strict=True):
        x = points()
        rows, weights = seen(x, grid)
        torch.testing.assert_close(
            (weights[..., None] * table[rows]).sum(dim=2), read(x, [grid], [table], True)
        )
        plain_rows, plain_weights = seen(x.requires_grad_(), grid)
        assert torch.equal(rows, plain_rows)
        torch.testing.assert_close(weights, plain_weights)


def test_single_precision_points_and_tables():
    _, grids, tables = made("periodic", torch.float32)
    x = points(dtype=torch.float32)
    found = read(x, grids, tables, True)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, read_plainly(x, grids, tables, True), atol=1e-4, rtol=1e-4)


def test_values_are_differentiable_twice():
    for kind in ("clamped", "cubic", "periodic"):
        grid, _, _ = made(kind)
        assert torch.autograd.gradgradcheck(grid, (points(4, reach=0.9).requires_grad_(),))


def test_transforms_and_other_types_take_plain_operations():
    grid, _, _ = made("clamped", torch.float32)
    x = points(5, dtype=torch.float32)
    assert suit_compiled(x, *grid.tables)
    assert not suit_compiled(x.half(), *grid.tables) and not suit_compiled(
        x.to("meta"), *grid.tables
    )
    jacobian = torch.vmap(torch.func.jacrev(lambda p: grid(p[None])[0]))(x)
    stack = grid.value_and_jacobian_stack(x)
    torch.testing.assert_close(jacobian, stack[1:].permute(1, 2, 0))


def test_no_points():
    _, grids, tables = made("clamped")
    assert read(points(0), grids, tables, True).shape == (3, 0, 6)
