"""A start for φ: the surface as a linear function of the encoding's features, by least squares.

A spline grid is linear in its tables, so that its best fit of a surface solves a sparse linear
system. That takes seconds; gradient steps take minutes to come as near. With δ = f − φ, the fit
minimises, over samples p, most of them uniform by area,

    mean ‖δ(p)‖² + μ mean ‖dδ(p)‖²,

dδ the derivative of δ along the surface. Its tilts are to first order those of the normal, so that
this is Eq. 1 (METHOD) made linear.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix, dia_matrix, diags, identity, kron
from torch import Tensor, nn

from nsm.data import SurfaceSampler
from nsm.domains import Surface
from nsm.maps import LatticeSplineGrid, NeuralMap
from nsm.maps.encodings import Encoding, SplineGrid, value_and_jacobian_stack
from nsm.tasks.multigrid import folding, lattice_refinements, solve, solve_through

# samples for each grid point or feature
_SAMPLES = 4
_FEWEST = 20_000
_AT_ONCE = 65_536
# of the samples, one of so many is on the boundary, so that both sides of a seam meet: measured on
# bunny, shrec07-384, cow and igea, this halves the gaps and leaves all else as it is
_BOUNDARY_EVERY = 33
# of the tables' second differences beside the mean weight of the samples: what no sample sees goes
# on straight, and the creases between triangles are not followed to the last. Measured on bunny,
# shrec07-384 and igea: a tenth of it has as good normals and more wrinkles, ten times it has worse
# normals
_SMOOTH = 0.1
_RIDGE = 1e-9
# the share of the mean stretch, squared, that a direction's own is taken to have at least
_FLATTEST = 1e-3
# μ; positions are the better for less, and normals hardly depend on it
_SLOPES = 1e-5
_STREAM = -2  # of the random numbers: no step has it


def fit_linear_skip(network: NeuralMap, surface: Surface, *, seed: int = 0) -> None:
    """Set a network's linear skip, and the tables of its grid, to the best fit of a surface.

    The network itself starts at zero. The levels of a grid are fitted in turn, each to the
    residual of the coarser ones.

    Args:
        network: φ with a linear skip, on the CPU.
        surface: the prepared surface.
        seed: of the samples.

    Raises:
        ValueError: a grid of fewer features than the linear skip has outputs.
    """
    assert network.linear_skip is not None
    encoding = network.encoding
    nn.init.zeros_(network.output.weight)
    nn.init.zeros_(network.output.bias)
    sampler = SurfaceSampler(surface)
    grid = encoding if isinstance(encoding, SplineGrid) else None
    unknowns = max(len(table) for table in grid.tables) if grid else encoding.out_dim
    samples, jacobian = sampler.with_jacobian(
        max(_FEWEST, _SAMPLES * unknowns), _BOUNDARY_EVERY, sampler.generator(seed, _STREAM)
    )
    along = _along(jacobian)
    wanted = torch.cat([samples.points[None], jacobian.permute(2, 0, 1)]).double()
    target = _rows(wanted, along)
    with torch.no_grad():
        if grid:
            _fit_tables(grid, network.linear_skip, samples.uv, along, target)
        else:
            _fit_weights(encoding, network.linear_skip, samples.uv, along, target)


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
    grid: SplineGrid, linear_skip: nn.Linear, uv: Tensor, along: Tensor, target: Tensor
) -> None:
    size = linear_skip.out_features
    if grid.features < size:
        raise ValueError(
            f"a grid that is fitted needs {size} features or more a level; with fewer, take "
            "initialization=random"
        )
    nn.init.zeros_(linear_skip.weight)
    nn.init.zeros_(linear_skip.bias)
    left = target.clone()
    column = grid.out_dim - grid.features * len(grid.tables)  # past x itself, if it is a feature
    for level, table in enumerate(grid.tables):
        count = min(len(uv), max(_FEWEST, _SAMPLES * len(table)))
        found = torch.as_tensor(_best(grid, level, uv[:count], along[:count], left[:, :count]))
        behind = len(uv) if level + 1 < len(grid.tables) else 0
        for part, rows, weights in _seen(grid, level, uv[:behind], along):
            left[:, part] -= (weights[..., None] * found[rows]).sum(dim=2)
        # tables of entries about 1, which steps of one rate suit
        scale = float(found.square().mean().sqrt().clamp(min=1e-30))
        table[:, :size] = found / scale
        linear_skip.weight[:, column : column + size] = scale * torch.eye(size)
        column += grid.features


def _seen(
    grid: SplineGrid, level: int, uv: Tensor, along: Tensor
) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Which samples, the rows (n, k²) that they see of a level's table, and the weights (3, n, k²)
    of these in the value and in the derivatives along the surface; part by part."""
    for start in range(0, len(uv), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        rows, weights = grid.seen(uv[part].double(), level)
        yield part, rows, _rows(weights, along[part])


def _best(grid: SplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor) -> np.ndarray:
    """The entries (rows, 3) of a level's table that fit best, their second differences held
    small."""
    if isinstance(grid, LatticeSplineGrid):
        matrix, right = _on_lattice(grid, level, uv, along, target)
        return solve_through(matrix, right, lattice_refinements(grid, level))
    matrix, right = _normal_equations(grid, level, uv, along, target)
    return solve(matrix, right, grid.resolutions[level], grid.degree)


def _sums(
    grid: SplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor, cell: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the samples of each cell, which see the same rows of the table: products of the
    weights (k⁴, rows), and of weights and target (rows, k², 3).

    Args:
        cell: which of the rows that a sample sees has the number of its cell.
    """
    rows, taps = len(grid.tables[level]), (grid.degree + 1) ** 2
    columns = target.shape[2]
    products = torch.zeros(rows, taps * taps, dtype=torch.float64)
    wanted = torch.zeros(rows, taps * columns, dtype=torch.float64)
    for part, seen, weights in _seen(grid, level, uv, along):
        pairs = torch.einsum("pna,pnb->nab", weights, weights)
        products.index_add_(0, seen[:, cell], pairs.flatten(1))
        with_target = torch.einsum("pna,pnk->nak", weights, target[:, part])
        wanted.index_add_(0, seen[:, cell], with_target.flatten(1))
    return products.t().contiguous().numpy(), wanted.view(rows, taps, columns).numpy()


def _normal_equations(
    grid: SplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor
) -> tuple[csr_matrix, np.ndarray]:
    """The matrix (rows, rows) and right side (rows, 3) of the best entries."""
    side, taps = grid.sides[level], (grid.degree + 1) ** 2
    size, columns = side**2, target.shape[2]
    of_pairs, of_target = _sums(grid, level, uv, along, target, cell=0)
    # row r of the table is the first that cell r sees; the others lie at fixed offsets from it
    offsets = [i * side + j for i in range(grid.degree + 1) for j in range(grid.degree + 1)]
    diagonals: dict[int, np.ndarray] = {}
    right = np.zeros((size, columns))
    for a, down in enumerate(offsets):
        right[down:] += of_target[: size - down, a]
        for b, across in enumerate(offsets):
            diagonal = diagonals.setdefault(across - down, np.zeros(size))
            diagonal[across:] += of_pairs[a * taps + b, : size - across]
    matrix = dia_matrix((np.stack(list(diagonals.values())), list(diagonals)), shape=(size, size))
    bend = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(side - 2, side))
    line = identity(side)
    smooth = kron(bend.T @ bend, line) + kron(line, bend.T @ bend)
    return _smoothed(matrix, smooth), right


def _on_lattice(
    grid: LatticeSplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor
) -> tuple[csr_matrix, np.ndarray]:
    """As :func:`_normal_equations`, on a closed domain."""
    size, columns = len(grid.tables[level]), target.shape[2]
    middle = (grid.degree + 1) ** 2 // 2
    of_pairs, of_target = _sums(grid, level, uv, along, target, cell=middle)
    seen = grid.cell_rows(level).numpy()
    down, across = np.repeat(seen, seen.shape[1], axis=1), np.tile(seen, seen.shape[1])
    matrix = coo_matrix(
        (of_pairs.T.ravel(), (down.ravel(), across.ravel())), shape=(size, size)
    ).tocsr()
    right = np.stack(
        [np.bincount(seen.ravel(), of_target[:, :, k].ravel(), size) for k in range(columns)],
        axis=1,
    )
    n, m = grid.cells(level)
    bends = []
    for count in (n, m):
        shift = identity(count, format="csr")[np.roll(np.arange(count), 1)]
        bend = shift - 2 * identity(count) + shift.T
        bends.append(bend.T @ bend)
    everywhere = kron(bends[0], identity(m)) + kron(identity(n), bends[1])
    fold = folding(grid, n, m)
    # of the coefficients of an orbit, each once
    smooth = fold.T @ everywhere @ fold * (size / (n * m))
    return _smoothed(matrix, smooth), right


def _smoothed(matrix: csr_matrix, smooth: csr_matrix) -> csr_matrix:
    weight = matrix.diagonal().mean()
    return (matrix + weight * (_SMOOTH * smooth + _RIDGE * identity(matrix.shape[0]))).tocsr()


def _fit_weights(
    encoding: Encoding, linear_skip: nn.Linear, uv: Tensor, along: Tensor, target: Tensor
) -> None:
    """Features without tables stay as they are: the linear skip's weights alone are fitted."""
    features = torch.cat([value_and_jacobian_stack(encoding, uv), torch.zeros(3, len(uv), 1)], 2)
    features[0, :, -1] = 1.0  # the bias
    design = _rows(features.double(), along).flatten(0, 1)
    normal, right = design.t() @ design, design.t() @ target.flatten(0, 1)
    normal += _RIDGE * normal.diagonal().mean() * torch.eye(len(normal))
    found = torch.linalg.solve(normal, right).t()
    linear_skip.weight.copy_(found[:, :-1])
    linear_skip.bias.copy_(found[:, -1])
