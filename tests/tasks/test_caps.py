"""The term that holds the caps of a part: its values in closed form, and what it does to folds."""

import numpy as np
import pytest
import torch
from torch import nn

from nsm.energies import Blend
from nsm.maps import build_analytic
from nsm.tasks.caps import _WEIGHT, Caps

UV = torch.tensor([[0.0, 0], [0.4, 0], [0.4, 0.4], [0, 0.4], [0.2, 0.2]])
FACES = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
ENERGY = Blend({"symmetric_dirichlet": 1.0})
FOLDING = 20.0


class Affine(nn.Module):
    """x ↦ x A."""

    def __init__(self, matrix):
        super().__init__()
        self.matrix = nn.Parameter(torch.tensor(matrix))

    def forward(self, x):
        return x @ self.matrix

    def value_and_jacobian(self, x):
        return self(x), self.matrix.T.expand(len(x), 2, 2)


def term(h, caps=None):
    plane = build_analytic({"name": "plane"})
    caps = caps or Caps(UV, FACES, plane, "smooth")
    return caps(h, plane, ENERGY, FOLDING, 0)


@pytest.mark.parametrize("stretch", [1.0, 0.5, 3.0])
def test_it_is_the_logarithm_of_the_distortion_where_nothing_folds(stretch):
    found = term(Affine([[stretch, 0.0], [0.0, stretch]]))
    energy = 2 * stretch**2 + 2 / (stretch**2 + 0.01)
    assert found.item() == pytest.approx(_WEIGHT * np.log1p(energy), rel=1e-4)


def test_folds_count_in_full():
    """A mirror image of the caps costs far more than any stretch of them."""
    flat, mirrored = term(Affine([[9.0, 0.0], [0.0, 9.0]])), term(Affine([[-1.0, 0.0], [0.0, 1.0]]))
    assert mirrored.item() > 100 * flat.item()


def test_its_curvature_is_that_of_the_term():
    """Along a change of J_h, against differences of the gradient, where the term is convex."""
    plane = build_analytic({"name": "plane"})
    caps = Caps(UV, FACES, plane, "smooth")
    h = Affine([[0.7, 0.1], [0.0, 0.8]])
    found = caps.curvature(h, plane, ENERGY, FOLDING, 0)
    assert np.allclose(found.points, UV[FACES].mean(dim=1))
    total = found.hessians.sum(dim=0)  # all triangles have one Jacobian: the matrix of h

    def gradient(shift):
        moved = Affine((h.matrix.detach().double() + shift).tolist())
        moved.matrix = nn.Parameter(moved.matrix.detach().float())
        (found,) = torch.autograd.grad(term(moved, caps), moved.matrix)
        return found.T.reshape(-1).double()

    step = 1e-2 * torch.eye(2, dtype=torch.float64)  # of the matrix, and of its transpose
    expected = (gradient(step) - gradient(-step)) / 2
    assert torch.allclose(total @ step.reshape(-1), expected, rtol=0.05, atol=1e-5)
