"""Multigrid on spline grids, against splines and direct solutions."""

import numpy as np
import pytest
import torch
from scipy.sparse import identity, kron
from scipy.sparse.linalg import spsolve

from nsm.maps.encodings import SplineGrid
from nsm.tasks.multigrid import refinement, solve


def spline(table: np.ndarray, cells: int, degree: int, uv: torch.Tensor) -> torch.Tensor:
    rows, weights = SplineGrid(2, [cells], 1, degree).seen(uv, 0)
    return (weights[0] * torch.as_tensor(table)[rows]).sum(dim=1)


@pytest.mark.parametrize("degree", [2, 3])
def test_refinement_is_the_same_spline(degree):
    table = np.random.default_rng(0).standard_normal((5 + degree) ** 2)
    uv = 2 * torch.rand(100, 2, dtype=torch.float64, generator=torch.manual_seed(0)) - 1
    coarse = spline(table, 5, degree, uv)
    fine = spline(refinement(5, degree) @ table, 10, degree, uv)
    torch.testing.assert_close(fine, coarse, rtol=0, atol=1e-12)


def test_solves_as_the_direct_method_does(monkeypatch):
    monkeypatch.setattr("nsm.tasks.multigrid._TOLERANCE", 1e-5)
    cells, degree = 144, 2  # two levels above the direct solution of the third, 36
    side = cells + degree
    bend = 2 * np.eye(side) - np.eye(side, k=1) - np.eye(side, k=-1)
    line = identity(side)
    matrix = (kron(bend, line) + kron(line, bend) + 1e-3 * identity(side**2)).tocsr()
    right = np.random.default_rng(1).standard_normal((side**2, 2))
    right[:, 1] = 0
    found, expected = solve(matrix, right, cells, degree), spsolve(matrix.tocsc(), right[:, 0])
    assert np.abs(found[:, 0] - expected).max() < 1e-3 * np.abs(expected).max()
    assert np.linalg.norm(matrix @ found - right) < 2e-5 * np.linalg.norm(right)
    assert not found[:, 1].any()
