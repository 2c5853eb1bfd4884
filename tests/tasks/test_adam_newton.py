"""Adam on the levels of a spline, and the quasi-Newton steps that follow."""

import copy

import pytest
import torch

from nsm.maps import PlanarMap, SplineField
from nsm.tasks.fold_barrier import Folds
from nsm.tasks.multilevel_adam import MultilevelAdam
from nsm.tasks.optimizers import build_optimizer
from nsm.tasks.spline_level import Level

SETTINGS = {
    "_target_": "nsm.tasks.adam_newton.AdamThenNewton",
    "newton_from": 0.75,
    "iterations": 10,
    "smoothing": 0.0,
    "lr": 0.05,
}
KINDS = [(False, False), (True, False), (True, True)]  # periodic, odd


@pytest.mark.parametrize("periodic, odd", KINDS)
def test_a_step_is_that_of_torch_on_the_coordinates_of_the_levels(periodic, odd):
    field = SplineField(2, 16, periodic, odd).double()
    generator = torch.Generator().manual_seed(3)
    ups = [torch.from_numpy(Level(field, n).up.toarray()) for n in (4, 8, 16)]
    y = [torch.zeros(up.shape[1], 2, dtype=torch.float64, requires_grad=True) for up in ups]
    reference = torch.optim.Adam(y, lr=0.02, betas=(0.9, 0.99), eps=1e-12)
    adam, state = MultilevelAdam(field, (0.9, 0.99), 1e-12, largest=0.3), {}
    c = torch.zeros_like(field.coefficients)
    for step in range(4):
        # a different gradient in each step, some of them longer than the limit
        gradient = torch.randn(c.shape, generator=generator).double() * 10.0 ** (step - 2)
        c += adam.changes([gradient], [state], step, 0.02)[0]
        for part, up, n in zip(y, ups, (4, 8, 16), strict=True):
            part.grad = 0.5 / n**0.5 * (up.T @ gradient)
        torch.nn.utils.clip_grad_norm_(y, 0.3)
        reference.step()
        scaled = zip(y, ups, (4, 8, 16), strict=True)
        wanted = sum(0.5 / n**0.5 * (up @ part.detach()) for part, up, n in scaled)
        torch.testing.assert_close(c, wanted, rtol=1e-4, atol=1e-7)


class Fit:
    """Least squares of h at fixed points, whose minimum is known."""

    def __init__(self):
        field = SplineField(2, 8).double()
        self.h = PlanarMap(field)
        self.optimizer = build_optimizer(self.h, SETTINGS, max_steps=20)
        x = 1.6 * torch.rand(400, 2, generator=torch.Generator().manual_seed(0)).double() - 0.8
        self.x, self.y = x, x + 0.1 * torch.stack([x[:, 0] * x[:, 1], x[:, 1] ** 2], dim=1)

    def loss(self):
        return ((self.h(self.x) - self.y) ** 2).mean()

    def step(self):
        def closure():
            self.optimizer.zero_grad()
            loss = self.loss()
            loss.backward()
            return loss

        return self.optimizer.step(closure)


def test_quasi_newton_steps_end_what_adam_began():
    fit = Fit()
    before = float(fit.loss().detach())
    for _ in range(15):
        fit.step()
    after_adam = float(fit.loss().detach())
    for _ in range(5):
        fit.step()
    assert after_adam < 0.5 * before
    # quadratics are splines of degree 2: the minimum is zero
    assert float(fit.loss().detach()) < 1e-3 * after_adam


@pytest.mark.parametrize("at", [4, 16])  # within either part
def test_a_resumed_training_ends_at_the_same(at):
    whole = Fit()
    for _ in range(at):
        whole.step()
    kept = copy.deepcopy((whole.h.state_dict(), whole.optimizer.state_dict()))
    resumed = Fit()
    resumed.h.load_state_dict(kept[0])
    resumed.optimizer.load_state_dict(kept[1])
    for _ in range(20 - at):
        whole.step()
        resumed.step()
    ends = zip(whole.h.parameters(), resumed.h.parameters(), strict=True)
    assert all(torch.equal(a, b) for a, b in ends)


def test_the_smooth_term_holds_what_a_step_begins_with():
    folds = Folds("smooth")
    first = torch.tensor([4.0, 1.0, 0.2, -0.5])
    began = folds(first, step=0)
    assert began[:3].eq(0).all() and began[3] > 1
    # a third of a determinant is free, whatever its size; less costs
    assert folds(first / 3, step=0)[:3].eq(0).all()
    assert (folds(first / 5, step=0)[:3] > 0).all()
    assert folds(first / 5, step=1)[:3].eq(0).all()  # the next step begins there
    assert Folds("exponential")(first, step=0).gt(0).tolist() == [False, False, False, True]


def test_moments_of_an_earlier_version_go_on():
    field = SplineField(2, 16, True, True).double()
    generator = torch.Generator().manual_seed(3)
    gradients = torch.randn(2, *field.coefficients.shape, generator=generator).double()
    adam = MultilevelAdam(field, (0.9, 0.99), 1e-12, largest=1.0)
    state = {}
    adam.changes([gradients[0]], [state], 0, 0.02)
    earlier = {key: moments.flatten(2).mT.clone() for key, moments in state.items()}  # (2, rows, d)
    [wanted] = adam.changes([gradients[1]], [state], 1, 0.02)
    [found] = adam.changes([gradients[1]], [earlier], 1, 0.02)
    torch.testing.assert_close(found, wanted)


def test_splines_alike_take_a_step_in_one_batch_as_each_would():
    field = SplineField(2, 16, True, True).double()
    generator = torch.Generator().manual_seed(3)
    adam, several, alone = (
        MultilevelAdam(field, (0.9, 0.99), 1e-12, largest=1.0),
        [{}, {}],
        [{}, {}],
    )
    for step in range(3):
        # of one alone the gradient is longer than the limit
        gradients = torch.randn(2, *field.coefficients.shape, generator=generator).double()
        gradients[0] *= 1e-3
        found = adam.changes(list(gradients), several, step, 0.02)
        for g, state, change in zip(gradients, alone, found, strict=True):
            torch.testing.assert_close(change, adam.changes([g], [state], step, 0.02)[0])
