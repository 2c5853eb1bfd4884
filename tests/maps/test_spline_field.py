"""A spline field is linear, and its products, slopes and tables agree with plain formulas."""

import pytest
import torch

from nsm.maps import Remembered, SplineField, Tabulated, build_analytic, build_stored


def field(periodic, cells=8, dtype=torch.float64):
    torch.manual_seed(0)
    made = SplineField(3, cells, periodic).to(dtype)
    with torch.no_grad():
        made.coefficients.normal_()
    return made


def points(count=200):
    return 2 * torch.rand(count, 2, dtype=torch.float64) - 1


@pytest.mark.parametrize("periodic", [False, True])
def test_value_and_slopes_agree_with_autograd(periodic):
    f, x = field(periodic), points().requires_grad_()
    value, jacobian = f.value_and_jacobian(x.detach())
    plain = f(x)
    torch.testing.assert_close(value, plain)
    for k in range(3):
        slope = torch.autograd.grad(plain[:, k].sum(), x, retain_graph=True)[0]
        torch.testing.assert_close(jacobian[:, k], slope)
    with torch.no_grad():
        torch.testing.assert_close(f.value_and_jacobian(x.detach())[1], jacobian)


@pytest.mark.parametrize("periodic", [False, True])
def test_gradient_by_the_coefficients(periodic):
    f, x = field(periodic, cells=4), points(20)

    def loss(c):
        at = x.clone().requires_grad_()  # by plain operations
        return (torch.func.functional_call(f, {"coefficients": c}, (at,)) ** 3).sum()

    torch.autograd.gradcheck(loss, (f.coefficients.detach().clone().requires_grad_(),))
    plain = torch.autograd.grad(loss(f.coefficients), f.coefficients)[0]
    read = torch.autograd.grad((f(x) ** 3).sum(), f.coefficients)[0]
    torch.testing.assert_close(read, plain)


def test_values_are_linear_in_the_coefficients():
    f, x = field(False), points()
    before = f(x)
    with torch.no_grad():
        f.coefficients.mul_(2)
    torch.testing.assert_close(f(x), 2 * before)


def test_what_a_validation_has_remembered_serves_the_training():
    f, x = field(False), points()
    phi = Remembered(build_analytic({"name": "saddle"}))
    with torch.inference_mode():
        f(x)
        slopes = phi.value_and_jacobian(x.float())[1]
    loss = (f(x) ** 2).sum() + (f(x).float() * slopes[..., 0]).sum()
    assert torch.autograd.grad(loss, f.coefficients)[0].isfinite().all()


def test_a_tables_gradient_is_by_its_slopes():
    table, x = Tabulated(build_analytic({"name": "saddle"}), 32), 0.9 * points().float()
    jacobian = table.value_and_jacobian(x)[1]
    at = x.clone().requires_grad_()
    weights = torch.randn(len(x), 3)
    found = torch.autograd.grad((weights * table(at)).sum(), at)[0]
    torch.testing.assert_close(found, (weights[:, None] @ jacobian)[:, 0])


def test_periodic_and_clamped():
    x = points()
    torch.testing.assert_close(field(True)(x + 2), field(True)(x))
    f = field(False)
    torch.testing.assert_close(f(torch.tensor([[1.5, 0.3]])), f(torch.tensor([[1.0, 0.3]])))


def test_it_is_made_again_from_its_settings():
    f = field(True, cells=12, dtype=torch.float32)
    again = build_stored(f.config)
    again.load_state_dict(f.state_dict())
    x = points().float()
    torch.testing.assert_close(again(x), f(x))


def test_a_table_is_near_the_surface():
    saddle = build_analytic({"name": "saddle"})
    x = 0.9 * points().float()
    value, jacobian = saddle.value_and_jacobian(x)
    errors = []
    for cells in (32, 64):
        table = Tabulated(saddle, cells)
        near, slopes = table.value_and_jacobian(x)
        torch.testing.assert_close(table(x), near)
        errors.append(float((near - value).abs().max()))
        assert float((slopes - jacobian).abs().max()) < 0.01
    assert errors[1] < 1e-4


def test_a_periodic_table_is_periodic():
    def wave(x):
        return torch.stack([(torch.pi * x[:, 0]).sin(), (torch.pi * x[:, 1]).cos()], dim=1)

    class Wave(torch.nn.Module):
        def forward(self, x):
            return wave(x)

    table, x = Tabulated(Wave(), 64, periodic=True), points().float()
    torch.testing.assert_close(table(x), wave(x), atol=1e-3, rtol=0)
    torch.testing.assert_close(table(x + 2), table(x), atol=1e-5, rtol=0)


def test_a_surface_is_remembered_at_the_same_points_alone():
    class Counted(torch.nn.Module):
        calls = 0

        def value_and_jacobian(self, x):
            self.calls += 1
            return x, x[..., None] * x[..., None, :]

    inner = Counted()
    phi, x = Remembered(inner), points()
    with torch.no_grad():
        first = phi.value_and_jacobian(x)[1]
        assert phi.value_and_jacobian(x.clone())[1] is first
        assert inner.calls == 1
        x[0] += 1.0
        assert torch.equal(phi.value_and_jacobian(x)[0], x)
    assert inner.calls == 2
