"""Every energy and constraint on any finite input: finite, with a finite gradient."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from metric_samples import Disc, Square
from thorough import examples

from nsm import energies
from nsm.energies import ENERGIES, first_fundamental_form

LARGEST = 2.0**59  # what the energies are made for (see first_fundamental_form)
SPECIAL = [0.0, 2.0**-100, -(2.0**-60), 2.0**-27, 1.0, -1.0, 2.0**27, -(2.0**50), LARGEST]
ENTRY = (
    st.floats(-LARGEST, LARGEST, width=32) | st.sampled_from(SPECIAL) | st.floats(-2, 2, width=32)
)


def tensors(*shape: int) -> st.SearchStrategy[torch.Tensor]:
    return arrays.arrays(np.float32, shape, elements=ENTRY).map(
        lambda a: torch.from_numpy(a.copy())
    )


def check_finite(value: torch.Tensor, *given_: torch.Tensor) -> None:
    assert value.isfinite().all()
    if value.requires_grad:
        gradients = torch.autograd.grad(value.double().mean(), given_, allow_unused=True)
        assert all(g is None or g.isfinite().all() for g in gradients)


@pytest.mark.parametrize("name", ENERGIES)
@examples(15)
@given(a=tensors(2, 3, 2), b=tensors(2, 3, 2))
def test_energies(name, a, b):
    a, b = a.requires_grad_(), b.requires_grad_()
    value = ENERGIES[name]()(first_fundamental_form(a), first_fundamental_form(b))
    assert (value >= 0).all()
    check_finite(value, a, b)


@pytest.mark.parametrize("name", ENERGIES)
@examples(10)
@given(
    a=arrays.arrays(np.float64, (3, 2), elements=st.floats(-3, 3)),
    b=arrays.arrays(np.float64, (3, 2), elements=st.floats(-3, 3)),
    axis=arrays.arrays(np.float64, 3, elements=st.floats(-1, 1)),
    turn=st.floats(-math.pi, math.pi),
)
def test_turning_either_surface_or_the_domain_changes_nothing(name, a, b, axis, turn):
    for jacobian in (a, b):
        if np.linalg.svd(jacobian, compute_uv=False).min() < 1e-2:
            return
    x, y, z = axis
    spin = torch.linalg.matrix_exp(
        torch.tensor([[0.0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    )
    c, s = math.cos(turn), math.sin(turn)
    plane = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    a, b = torch.from_numpy(a.copy()), torch.from_numpy(b.copy())

    def cost(first, second):
        return ENERGIES[name]()(first_fundamental_form(first), first_fundamental_form(second))

    expected = cost(a, b)
    for other in (cost(spin @ a, b), cost(a, spin @ b), cost(a @ plane, b @ plane)):
        assert torch.allclose(other, expected, rtol=1e-6, atol=1e-9)


# those that are no function of two metrics: what each is given, by the names of its arguments
GIVEN = {
    "boundary": (Disc(), (4, 2)),
    "first_fundamental_form": ((4, 3, 2),),
    "injectivity": ((4,),),
    "landmark": ((4, 3), (4, 3)),
    "normal": ((4, 3, 2), (4, 3)),
    "outside": (Square(), (4, 2)),
    "position": ((4, 3), (4, 3)),
    "unfold": ((4,),),
}
OF_MAPS = {
    "area_element", "curvatures", "jacobian", "laplace_beltrami", "normals", "second_derivatives",
    "second_fundamental_form", "surface_gradient",
}  # fmt: skip
# tested elsewhere: they use the above, or give no values of energies
OTHER = {
    "ENERGIES", "At", "Blend", "Curvatures", "Energy", "Invariants", "call_energy", "inside",
    "pullback_invariants", "rotation", "spectrum", *(kind.__name__ for kind in ENERGIES.values()),
}  # fmt: skip


@pytest.mark.parametrize("name", GIVEN)
@examples(10)
@given(data=st.data())
def test_terms(name, data):
    arguments = [
        data.draw(tensors(*x)).requires_grad_() if isinstance(x, tuple) else x for x in GIVEN[name]
    ]
    value = getattr(energies, name)(*arguments)
    if name == "first_fundamental_form" and max(arguments[0].detach().abs().max(), 0) > 1e17:
        return  # its squares leave float32
    check_finite(value, *(x for x in arguments if isinstance(x, torch.Tensor)))


@pytest.mark.parametrize("name", sorted(OF_MAPS))
@examples(10)
@given(
    bend=arrays.arrays(np.float64, 3, elements=st.floats(-1e3, 1e3)),
    uv=arrays.arrays(np.float64, (4, 2), elements=st.floats(-1e3, 1e3)),
)
def test_operators_of_any_graph_and_its_mirror_image(name, bend, uv):
    """Values are finite; mirrored in its plane, z becomes -z, and curvatures change sign."""
    a, b, c = bend.tolist()
    with_function = name in ("surface_gradient", "laplace_beltrami")
    function = [lambda x: x[:, 0] ** 2 - x[:, 1]] if with_function else []

    def value(sign):
        def graph(x):
            u, v = x.unbind(-1)
            return torch.stack([u, v, sign * (a * u**2 + b * u * v + c * v**2)], dim=-1)

        return getattr(energies, name)(graph, *function, torch.from_numpy(uv.copy()))

    here, there = value(1), value(-1)
    if name == "curvatures":
        assert torch.allclose(here.mean, -there.mean) and torch.allclose(
            here.gaussian, there.gaussian
        )
        here, there = torch.stack(here), torch.stack(there)
    assert here.isfinite().all() and there.isfinite().all()
    if here.ndim == 1:
        assert torch.allclose(here, there, rtol=1e-6, atol=1e-9)


def test_everything_public_is_tried():
    assert set(energies.__all__) == {*GIVEN, *OF_MAPS, *OTHER, *ENERGIES}
    assert all(callable(getattr(energies, name)) for name in GIVEN)
