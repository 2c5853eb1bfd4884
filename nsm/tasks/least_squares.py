"""A start for φ: the surface as a linear function of the encoding's features, by least squares.

A spline grid is linear in its tables, so that the best surface it holds is the solution of a sparse
linear system: some seconds, where gradient steps take minutes to come as near. What is minimised
over samples p, with δ = f − φ, is

    mean ‖δ(p)‖² + μ mean ‖dδ(p)‖²,

dδ the derivative of δ along the surface. Its tilts are to first order those of the normal, so that
this is Eq. 1 (METHOD) made linear.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags, identity, kron
from scipy.sparse.linalg import splu
from torch import Tensor, nn

from nsm.data import SurfaceSampler
from nsm.maps import NeuralMap
from nsm.maps.encodings import Encoding, SplineGrid, value_and_jacobian_stack
from nsm.surfaces import Surface

# samples for each grid point or feature
_SAMPLES = 5
_FEWEST = 20_000
# of the tables' second differences beside the mean weight of the samples: what no sample sees goes
# on straight
_SMOOTH = 1e-6
_RIDGE = 1e-9
# the share of the mean stretch, squared, that a direction's own is taken to have at least
_FLATTEST = 1e-3
# μ; from 1e-4 to 1e-2 the normals come out the same, and the positions are the better for less
_SLOPES = 1e-4
_STREAM = -2  # of the random numbers: no step has it


def fit_readout(network: NeuralMap, surface: Surface, *, seed: int = 0) -> None:
    """Set a network's read-out, and the tables of its grid, to the best fit of a surface.

    The network itself starts at zero behind it. The levels of a grid are fitted in turn, each to
    what the coarser ones leave.

    Args:
        network: φ with a read-out, on the CPU.
        surface: the prepared surface.
        seed: of the samples.

    Raises:
        ValueError: a grid of fewer features than the read-out has coordinates.
    """
    assert network.readout is not None
    encoding = network.encoding
    nn.init.zeros_(network.output.weight)
    nn.init.zeros_(network.output.bias)
    sampler = SurfaceSampler(surface)
    grid = encoding if isinstance(encoding, SplineGrid) else None
    unknowns = max(len(table) for table in grid.tables) if grid else encoding.out_dim
    samples, jacobian = sampler.by_area_with_jacobian(
        max(_FEWEST, _SAMPLES * unknowns), sampler.generator(seed, _STREAM)
    )
    along = _along(jacobian)
    wanted = torch.cat([samples.points[None], jacobian.permute(2, 0, 1)]).double()
    target = _rows(wanted, along)
    with torch.no_grad():
        if grid:
            _fit_tables(grid, network.readout, samples.uv, along, target)
        else:
            _fit_weights(encoding, network.readout, samples.uv, along, target)


def _along(jacobian: Tensor) -> Tensor:
    """√μ L (N, 2, 2), LLᵀ the inverse metric: its columns turn derivatives by u and v into those
    along two orthonormal directions of the surface. Zero where a triangle has none."""
    j = jacobian.double()
    metric = j.transpose(1, 2) @ j
    floor = _FLATTEST * metric.diagonal(dim1=1, dim2=2).mean(dim=1)
    metric = metric + floor[:, None, None] * torch.eye(2, dtype=metric.dtype)
    root = torch.linalg.cholesky_ex(torch.linalg.inv_ex(metric).inverse).L
    known = torch.isfinite(root).all(dim=2).all(dim=1)
    return _SLOPES**0.5 * torch.where(known[:, None, None], root, 0.0)


def _rows(stack: Tensor, along: Tensor) -> Tensor:
    """Values and derivatives by u and v (3, N, d) to values and derivatives along the surface."""
    return torch.cat([stack[:1], torch.einsum("ind,nij->jnd", stack[1:], along)])


def _fit_tables(
    grid: SplineGrid, readout: nn.Linear, uv: Tensor, along: Tensor, target: Tensor
) -> None:
    size = readout.out_features
    if grid.features < size:
        raise ValueError(f"a grid that is fitted needs {size} features or more a level")
    nn.init.zeros_(readout.weight)
    nn.init.zeros_(readout.bias)
    left = target.numpy()
    column = grid.out_dim - grid.features * len(grid.tables)
    for level, table in enumerate(grid.tables):
        count = min(len(uv), max(_FEWEST, _SAMPLES * len(table)))
        design = _design(grid, level, uv, along)
        of_part = design if count == len(uv) else _design(grid, level, uv[:count], along[:count])
        found = _solved(of_part, left[:, :count].reshape(-1, size), grid.sides[level])
        left = left - (design @ found).reshape(left.shape)
        # tables of entries about 1, which steps of one rate suit
        scale = max(float(np.sqrt((found**2).mean())), 1e-30)
        table[:, :size] = torch.as_tensor(found / scale)
        readout.weight[:, column : column + size] = scale * torch.eye(size)
        column += grid.features


def _design(grid: SplineGrid, level: int, uv: Tensor, along: Tensor) -> csr_matrix:
    """From a level's table to values and derivatives along the surface: (3 N, rows)."""
    rows, weights = grid.seen(uv.double(), level)
    weights = _rows(weights, along)
    taps = rows.shape[1]
    return csr_matrix(
        (
            weights.flatten().numpy(),
            rows.repeat(3, 1).flatten().numpy(),
            np.arange(0, weights.numel() + 1, taps),
        ),
        shape=(weights.numel() // taps, len(grid.tables[level])),
    )


def _solved(design: csr_matrix, target: np.ndarray, side: int) -> np.ndarray:
    """The table (side², 3) that fits best, its second differences held small."""
    normal = (design.T @ design).tocsc()
    weight = normal.diagonal().mean()
    bend = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(side - 2, side))
    line = identity(side)
    smooth = kron(bend.T @ bend, line) + kron(line, bend.T @ bend)
    matrix = normal + weight * (_SMOOTH * smooth + _RIDGE * identity(side**2))
    # symmetric and positive: no pivoting, and an ordering that knows it
    symmetric = {"SymmetricMode": True}
    factors = splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric
    )
    return factors.solve(design.T @ target)


def _fit_weights(
    encoding: Encoding, readout: nn.Linear, uv: Tensor, along: Tensor, target: Tensor
) -> None:
    """Features without tables stay as they are: the read-out's weights alone are fitted."""
    features = torch.cat([value_and_jacobian_stack(encoding, uv), torch.zeros(3, len(uv), 1)], 2)
    features[0, :, -1] = 1.0  # the bias
    design = _rows(features.double(), along).flatten(0, 1)
    normal, right = design.t() @ design, design.t() @ target.flatten(0, 1)
    normal += _RIDGE * normal.diagonal().mean() * torch.eye(len(normal))
    found = torch.linalg.solve(normal, right).t()
    readout.weight.copy_(found[:, :-1])
    readout.bias.copy_(found[:, -1])
