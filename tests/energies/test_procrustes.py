"""The rotation from landmarks."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.energies import rotation

ANGLES = st.floats(-math.pi, math.pi)


def turn(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s], [s, c]], dtype=torch.float64)


def landmarks(n, seed):
    return torch.randn(n, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@examples(100)
@given(angle=ANGLES, n=st.integers(1, 8), seed=st.integers(0, 10**6))
def test_recovers_a_rotation(angle, n, seed):
    p = landmarks(n, seed)
    torch.testing.assert_close(rotation(p, p @ turn(angle).T), turn(angle), rtol=0, atol=1e-9)


@examples(50)
@given(seed=st.integers(0, 10**6))
def test_is_the_best_of_all_rotations_and_never_a_reflection(seed):
    p, q = landmarks(4, seed), landmarks(4, seed + 1)
    r = rotation(p, q)
    torch.testing.assert_close(r @ r.T, torch.eye(2, dtype=r.dtype))
    assert torch.linalg.det(r).item() == pytest.approx(1)
    error = ((p @ r.T - q) ** 2).sum()
    for k in range(360):
        assert error <= ((p @ turn(math.radians(k)).T - q) ** 2).sum() + 1e-9


def test_is_a_rotation_even_if_a_reflection_would_fit():
    p = torch.tensor([[1.0, 0.0], [0.0, 0.5]])
    r = rotation(p, p * torch.tensor([1.0, -1.0]))
    torch.testing.assert_close(r, torch.eye(2))


@pytest.mark.parametrize(
    ("p", "q"),
    [
        ([], []),
        ([[0.0, 0.0]], [[1.0, 0.0]]),
        ([[1.0, 0.0]], [[0.0, 0.0]]),
        ([[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]]),
        ([[0.1, 0.7], [-0.1, -0.7]], [[0.3, 0.2], [0.3, 0.2]]),
    ],
)
def test_is_the_identity_where_nothing_decides(p, q):
    got = rotation(torch.tensor(p).reshape(-1, 2), torch.tensor(q).reshape(-1, 2))
    assert got.dtype == torch.float32
    assert torch.equal(got, torch.eye(2))


@pytest.mark.parametrize("shapes", [((3, 2), (2, 2)), ((3, 3), (3, 3)), ((2,), (2,))])
def test_shapes_must_match(shapes):
    with pytest.raises(ValueError):
        rotation(torch.ones(shapes[0]), torch.ones(shapes[1]))
