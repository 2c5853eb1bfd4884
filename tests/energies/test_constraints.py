"""Boundary, injectivity and landmark terms."""

import math

import pytest
import torch
from metric_samples import Disc, Square

from nsm.energies import boundary, injectivity, inside, landmark, outside, unfold

DISC, SQUARE = Disc(), Square()
DOMAINS = {"disc": DISC, "square": SQUARE}
DISTANCES = {
    "disc": [((0, 0), -1), ((0.5, 0), -0.5), ((0.6, 0.8), 0), ((3, 4), 4), ((0, -2), 1)],
    "square": [
        ((0, 0), -1),
        ((0.5, 0.2), -0.5),
        ((0.1, -0.9), -0.1),
        ((1, 0.3), 0),
        ((-1, 1), 0),
        ((2, 0.3), 1),
        ((0.2, -1.5), 0.5),
        ((4, 5), 5),
        ((-4, 5), 5),
    ],
}
CASES = [(domain, p, d) for domain, rows in DISTANCES.items() for p, d in rows]
EXTREMES = [0.0, -0.0, 1e-45, 1e-30, 1.0, -1.0, 1 + 1e-6, 1e18, -1e18, 1e30, 3.4e38, -3.4e38]


@pytest.mark.parametrize(("domain", "p", "distance"), CASES)
def test_distances_and_terms(domain, p, distance):
    point = torch.tensor([p], dtype=torch.float64)
    domain = DOMAINS[domain]
    assert boundary(domain, point).item() == pytest.approx(distance**2, abs=1e-12)
    assert outside(domain, point).item() == pytest.approx(max(distance, 0) ** 2, abs=1e-12)
    assert inside(domain, point, tolerance=1e-12).item() == (distance <= 0)


def test_image_slides_along_a_side():
    p = torch.tensor([[1.2, 0.3]], dtype=torch.float64, requires_grad=True)
    boundary(SQUARE, p).sum().backward()
    assert p.grad[0, 0].item() == pytest.approx(0.4) and p.grad[0, 1].item() == 0


@pytest.mark.parametrize("domain", DISTANCES)
@pytest.mark.parametrize("term", [boundary, outside])
def test_gradients(domain, term):
    p = torch.tensor([[0.3, 0.1], [1.7, 0.4], [-1.3, 1.6], [0.2, -0.8]], dtype=torch.float64)
    torch.autograd.gradcheck(lambda q: term(DOMAINS[domain], q), p.requires_grad_())


@pytest.mark.parametrize("domain", DISTANCES)
@pytest.mark.parametrize("term", [boundary, outside])
def test_extreme_points_stay_finite(domain, term):
    p = torch.cartesian_prod(torch.tensor(EXTREMES), torch.tensor(EXTREMES)).requires_grad_()
    value = term(DOMAINS[domain], p)
    value.sum().backward()
    assert value.dtype == torch.float32 and value.isfinite().all() and p.grad.isfinite().all()


def test_a_point_outside_is_pulled_back_and_one_inside_left_alone():
    p = torch.tensor([[0.0, 2.0], [0.1, 0.2]], requires_grad=True)
    outside(DISC, p).sum().backward()
    assert p.grad[0, 1] > 0 and (p.grad[1] == 0).all()


def test_tolerance_widens_the_mask():
    p = torch.tensor([[1.001, 0.0], [1.1, 0.0]])
    assert inside(DISC, p).tolist() == [False, False]
    assert inside(DISC, p, tolerance=0.01).tolist() == [True, False]


def test_points_of_space_are_refused():
    with pytest.raises(ValueError):
        boundary(DISC, torch.zeros(4, 3))


def test_injectivity_is_the_published_term():
    det = torch.tensor([2.0, 1e-3, 0.0, -0.5, -3.0, -19.0], dtype=torch.float64)
    want = (-det.sign() * (-det).exp()).clamp(min=0)
    assert want[3] > 0
    torch.testing.assert_close(injectivity(det), want, rtol=1e-12, atol=0)


def test_injectivity_goes_on_along_its_tangent():
    det = torch.tensor([-19.999999, -20.000001, -21.0, -100.0], dtype=torch.float64)
    det.requires_grad_()
    value = injectivity(det)
    slope = torch.autograd.grad(value.sum(), det)[0]
    assert value[1].item() == pytest.approx(value[0].item(), rel=1e-5)
    assert slope[1].item() == pytest.approx(slope[0].item(), rel=1e-5)
    assert value[3].item() == pytest.approx(math.exp(20) * 81)
    assert slope[3] == slope[2]


def test_injectivity_gradient_and_extremes():
    det = torch.tensor([0.5, -0.5, -25.0], dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(injectivity, det)
    extreme = torch.tensor(EXTREMES, requires_grad=True)
    value = injectivity(extreme)
    value.sum().backward()
    assert value.isfinite().all() and extreme.grad.isfinite().all()
    assert value[-1] > value[-4] > 0


@pytest.mark.parametrize("width", [2, 3])
def test_landmarks(width):
    p = torch.zeros(3, width)
    q = torch.ones(3, width)
    assert landmark(p, q).tolist() == [width] * 3
    assert landmark(p[:0], q[:0]).shape == (0,)


def test_landmarks_must_match():
    with pytest.raises(ValueError, match="targets"):
        landmark(torch.zeros(3, 2), torch.zeros(1, 2))


def test_far_landmarks_stay_finite():
    p = torch.tensor([[3e38, -3e38]], requires_grad=True)
    value = landmark(p, torch.zeros(1, 2))
    value.sum().backward()
    assert value.isfinite().all() and p.grad.isfinite().all()


def test_unfold_has_its_closed_form_and_slopes_below_zero():
    det = torch.tensor([-1.0, 0.0, 0.05, 0.1, 1.0], dtype=torch.float64, requires_grad=True)
    value = unfold(det, margin=0.1)
    assert torch.allclose(value, torch.tensor([21.0, 1.0, 0.25, 0.0, 0.0], dtype=torch.float64))
    (slope,) = torch.autograd.grad(value.sum(), det)
    assert torch.allclose(slope, torch.tensor([-20.0, -20, -10, 0, 0], dtype=torch.float64))
    assert unfold(torch.tensor([-3e38])).isfinite().all()
