"""A start for φ: the surface as a linear function of the encoding's features, by least squares.

A spline grid is linear in its tables, so that its best fit of a surface solves a sparse linear
system. That takes seconds; gradient steps take minutes to come as near. With δ = f − φ, the fit
minimises, over samples p, most of them uniform by area,

    mean ‖δ(p)‖² + μ mean ‖dδ(p)‖²,

dδ the derivative of δ along the surface. Its tilts are to first order those of the normal, so that
this is Eq. 1 (METHOD) made linear.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any, cast

import numpy as np
import torch
from scipy.sparse import csr_matrix, dia_matrix, diags, identity, kron, triu
from torch import Tensor, nn

from nsm.compiled import compiled
from nsm.data import SurfaceSampler
from nsm.domains import Surface
from nsm.instantiation import target_of
from nsm.maps import LatticeSplineGrid, LinearInFeatures, NeuralMap, bsplines, build_network
from nsm.maps.encodings import Encoding, SplineGrid, value_and_jacobian_stack
from nsm.stages import at
from nsm.tasks.multigrid import lattice_refinements, solve, solve_through

# samples for each grid point or feature
_SAMPLES = 4
_FEWEST = 20_000
_AT_ONCE = 16_384
# of the samples, one of so many is on the boundary, so that both sides of a seam meet: measured on
# bunny, shrec07-384, cow and igea, this halves the gaps and leaves all else as it is
_BOUNDARY_EVERY = 33
# of the tables' second differences beside the mean weight of the samples: what no sample sees goes
# on straight, and the creases between triangles are not followed to the last. Measured on bunny,
# igea, shrec07-384 and homer: a third of it has 4 to 13 % less error and 6 to 10 % more wrinkles,
# three times it has 19 to 34 % more error, normals worse by 0.1 to 0.25 degrees, and 9 to 21 % less
# wrinkles
_SMOOTH = 0.03
_RIDGE = 1e-9
# the share of the mean stretch, squared, that a direction's own is taken to have at least
_FLATTEST = 1e-3
# μ; positions are the better for less, and normals hardly depend on it
_SLOPES = 1e-5
_STREAM = -2  # of the random numbers: no step has it
_OF_LAYOUT = (32, 128)  # cells a side of the spline through a layout in the plane


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
    nn.init.zeros_(network.output.weight)
    nn.init.zeros_(network.output.bias)
    fit_linear(network.encoding, network.linear_skip, surface, seed)


def fitted_to_layout(uv: np.ndarray, surface: Surface, *, seed: int = 0) -> LinearInFeatures:
    """A spline Ω → R² that takes a surface's vertices to places in the plane, as near as it can.

    Args:
        uv: (V, 2) the places.
        surface: the prepared surface.
        seed: of the samples.
    """
    encoding = {"_target_": target_of(SplineGrid), "resolutions": _OF_LAYOUT, "features": 2}
    target = {"_target_": target_of(LinearInFeatures)}
    spline: Any = build_network(target, encoding=encoding, out_dim=2)
    flat = np.pad(uv, ((0, 0), (0, 1)))
    fit_linear(spline.encoding, spline.linear, replace(surface, vertices=flat), seed)
    return cast(LinearInFeatures, spline)


def fit_linear(encoding: Encoding, linear: nn.Linear, surface: Surface, seed: int) -> None:
    """Set a linear function of an encoding's features, and the tables of a grid, to the best fit.

    Args:
        encoding: with as many features a level as the function has values, if it is a grid.
        linear: the function; its values are the first coordinates of a point.
        surface: to be fitted.
        seed: of the samples.

    Raises:
        ValueError: a grid of fewer features than there are values.
    """
    sampler = SurfaceSampler(surface)
    grid = encoding if isinstance(encoding, SplineGrid) else None
    unknowns = max(len(table) for table in grid.tables) if grid else encoding.out_dim
    samples, jacobian = sampler.with_jacobian(
        max(_FEWEST, _SAMPLES * unknowns), _BOUNDARY_EVERY, sampler.generator(seed, _STREAM)
    )
    jacobian = jacobian.permute(2, 1, 0)
    along = _along(jacobian)
    target = _rows(torch.cat([samples.points.t()[None], jacobian]), along)
    target = target[:, : linear.out_features]
    with torch.no_grad():
        if grid:
            _fit_tables(grid, linear, samples.uv, along, target)
        else:
            _fit_weights(encoding, linear, samples.uv, along.double(), target.double())


def _along(jacobian: Tensor) -> Tensor:
    """√μ L (2, 2, N), LLᵀ the inverse metric: its columns turn derivatives by u and v into those
    along two orthonormal directions of the surface. Zero where a triangle has none.

    Args:
        jacobian: (2, 3, N), the derivatives by u and v; points innermost, as everywhere here, so
            that the processor has long rows.
    """
    du, dv = jacobian
    a, b, c = (du * du).sum(dim=0), (du * dv).sum(dim=0), (dv * dv).sum(dim=0)
    floor = _FLATTEST * 0.5 * (a + c)
    a, c = a + floor, c + floor
    determinant = a * c - b * b
    root = torch.zeros(2, 2, len(a), dtype=a.dtype)
    root[0, 0] = (c / determinant).sqrt()
    root[1, 0] = -b / (determinant * root[0, 0])
    root[1, 1] = c.rsqrt()
    known = torch.isfinite(root).all(dim=0).all(dim=0)
    return _SLOPES**0.5 * torch.where(known, root, 0.0)


def _rows(stack: Tensor, along: Tensor) -> Tensor:
    """Values and derivatives by u and v (3, d, N) to values and derivatives along the surface."""
    first, second = stack[1:]
    slopes = [first * way[0] + second * way[1] for way in along.unbind(dim=1)]
    return torch.stack([stack[0], *slopes])


def _fit_tables(
    grid: SplineGrid, linear_skip: nn.Linear, uv: Tensor, along: Tensor, target: Tensor
) -> None:
    """As :func:`_fit_weights`, of the tables of a grid."""
    size = linear_skip.out_features
    if grid.features < size:
        raise ValueError(
            f"a grid that is fitted needs {size} features or more a level; with fewer, take "
            "initialization=random"
        )
    nn.init.zeros_(linear_skip.weight)
    nn.init.zeros_(linear_skip.bias)
    # neighbours follow each other: what they see of a table, and add to, is near in memory
    order = grid.seen(uv, len(grid.tables) - 1)[0][:, 0].argsort()
    uv, along, left = uv[order], along[..., order], target[..., order]
    column = grid.out_dim - grid.features * len(grid.tables)  # past x itself, if it is a feature
    for level, table in enumerate(grid.tables):
        at(f"equations of level {level + 1} of {len(grid.tables)} of the grid")
        enough = order < max(_FEWEST, _SAMPLES * len(table))
        some = (part if enough.all() else part[..., enough] for part in (uv.t(), along, left))
        found = torch.as_tensor(_best(grid, level, *some)).to(left)
        if level + 1 < len(grid.tables):
            part = bsplines.read(uv, grid.grids[level : level + 1], [found], tangents=True)
            left -= _rows(part.mT, along)
        # tables of entries about 1, which steps of one rate suit
        scale = float(found.square().mean().sqrt().clamp(min=1e-30))
        table[:, :size] = found / scale
        linear_skip.weight[:, column : column + size] = scale * torch.eye(size)
        column += grid.features


def _best(grid: SplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor) -> np.ndarray:
    """The entries (rows, 3) of a level's table that fit best, their second differences held
    small."""
    if isinstance(grid, LatticeSplineGrid):
        matrix, right = _on_lattice(grid, level, uv, along, target)
        at(f"solution of {len(right):,} equations")
        return solve_through(matrix, right, lattice_refinements(grid, level))
    matrix, right = _normal_equations(grid, level, uv, along, target)
    at(f"solution of {len(right):,} equations")
    return solve(matrix, right, grid.resolutions[level], grid.degree)


def _sums(
    grid: SplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor, cell: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the samples of each cell, which see the same rows of the table: products of the
    weights a and b of each pair a <= b of these rows (k² (k² + 1) / 2, rows), in the order of
    ``_pairs``, and of weights and target (k², columns, rows).

    Args:
        cell: which of the rows that a sample sees has the number of its cell.
    """
    count, taps, columns = len(grid.tables[level]), (grid.degree + 1) ** 2, target.shape[1]
    products = np.zeros((count, len(_pairs(taps))))
    wanted = np.zeros((count, taps, columns))
    for start in range(0, uv.shape[1], _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        rows, weights = grid.seen(uv[:, part].t(), level)
        wished = target[..., part].contiguous().numpy()
        turned = along[..., part].contiguous().numpy()
        _add_up(rows[:, cell].numpy(), weights.numpy(), turned, wished, products, wanted)
    return np.ascontiguousarray(products.T), np.ascontiguousarray(wanted.transpose(1, 2, 0))


@compiled
def _add_up(
    of: np.ndarray,
    weights: np.ndarray,
    along: np.ndarray,
    target: np.ndarray,
    products: np.ndarray,
    wanted: np.ndarray,
) -> None:
    """Add what samples see to the sums of their cells.

    Args:
        of: (n,) cells.
        weights: (3, n, k²) in the value and in the derivatives by u and v.
        along: (2, 2, n), which turns these into derivatives along the surface.
        target: (3, columns, n), the value and the derivatives along the surface.
        products: (rows, k² (k² + 1) / 2).
        wanted: (rows, k², columns).
    """
    taps, columns = weights.shape[2], target.shape[1]
    w = np.empty((3, taps))
    for p in range(len(of)):
        cell, pair = of[p], 0
        for a in range(taps):
            by_u, by_v = weights[1, p, a], weights[2, p, a]
            w[0, a] = weights[0, p, a]
            w[1, a] = by_u * along[0, 0, p] + by_v * along[1, 0, p]
            w[2, a] = by_u * along[0, 1, p] + by_v * along[1, 1, p]
        for a in range(taps):
            for b in range(a, taps):
                products[cell, pair] += w[0, a] * w[0, b] + w[1, a] * w[1, b] + w[2, a] * w[2, b]
                pair += 1
            for c in range(columns):
                for k in range(3):
                    wanted[cell, a, c] += w[k, a] * target[k, c, p]


def _pairs(taps: int) -> list[tuple[int, int]]:
    """The pairs (a, b), a <= b, of the places of a table that a sample sees."""
    return [(a, b) for a in range(taps) for b in range(a, taps)]


def _normal_equations(
    grid: SplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor
) -> tuple[csr_matrix, np.ndarray]:
    """The matrix (rows, rows) and right side (rows, 3) of the best entries."""
    side = grid.sides[level]
    size, columns = side**2, target.shape[1]
    of_pairs, of_target = _sums(grid, level, uv, along, target, cell=0)
    # row r of the table is the first that cell r sees; the others lie at fixed offsets from it
    offsets = [i * side + j for i in range(grid.degree + 1) for j in range(grid.degree + 1)]
    diagonals: dict[int, np.ndarray] = {}
    right = np.zeros((size, columns))
    for a, down in enumerate(offsets):
        right[down:] += of_target[a, :, : size - down].T
    for products, (a, b) in zip(of_pairs, _pairs(len(offsets)), strict=True):
        across = offsets[b]
        diagonal = diagonals.setdefault(across - offsets[a], np.zeros(size))
        diagonal[across:] += products[: size - across]
    upper = dia_matrix((np.stack(list(diagonals.values())), list(diagonals)), shape=(size, size))
    matrix = upper.tocsr() + triu(upper, 1).T
    bend = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(side - 2, side))
    line = identity(side)
    smooth = kron(bend.T @ bend, line) + kron(line, bend.T @ bend)
    return _smoothed(matrix, smooth), right


def _on_lattice(
    grid: LatticeSplineGrid, level: int, uv: Tensor, along: Tensor, target: Tensor
) -> tuple[csr_matrix, np.ndarray]:
    """As :func:`_normal_equations`, on a closed domain."""
    n, m = grid.cells(level)
    size, taps = len(grid.tables[level]), grid.degree + 1
    of_pairs, of_target = _sums(grid, level, uv, along, target, cell=taps**2 // 2)
    seen = grid.cell_rows(level).numpy().T
    right = np.zeros((size, target.shape[1]))
    for rows, of_columns in zip(seen, of_target, strict=True):
        right += np.stack([np.bincount(rows, sums, size) for sums in of_columns], axis=1)
    # row r is the coefficient (i, j) in the middle of cell r; where a cell sees (-i, -j) for it,
    # steps from there to other coefficients are the opposite of those from (i, j)
    low = m // 2 if grid.even else 0
    j = np.tile(np.arange(low, m), n)
    places = list(product(range(-(taps // 2), taps // 2 + 1), repeat=2))
    turned = [np.flatnonzero((j + q) % m < low) for _, q in places]
    entries = {step: np.zeros(size) for step in product(range(1 - taps, taps), repeat=2)}
    for products, (a, b) in zip(of_pairs, _pairs(len(seen)), strict=True):
        for start, end in dict.fromkeys([(a, b), (b, a)]):
            p, q = (there - here for here, there in zip(places[start], places[end], strict=True))
            other = np.bincount(seen[start][turned[start]], products[turned[start]], size)
            entries[p, q] += np.bincount(seen[start], products, size) - other
            entries[-p, -q] += other
    nearby = torch.arange(1 - taps, taps, dtype=torch.int32)
    down = torch.arange(n, dtype=torch.int32)[:, None, None, None] + nearby[:, None]
    across = torch.arange(low, m, dtype=torch.int32)[:, None, None] + nearby
    columns = grid.rows_of(down, across, (n, m)).reshape(size, -1).numpy()
    values = np.stack(list(entries.values()), axis=1)
    # near a cone, some neighbours of a coefficient are the coefficient itself
    weight = values[columns == np.arange(size)[:, None]].sum() / size
    values += weight * np.array([_SMOOTH * _bending(*step) for step in entries])
    values[:, values.shape[1] // 2] += weight * _RIDGE
    rows = np.arange(size + 1) * len(entries)
    matrix = csr_matrix((values.ravel(), columns.ravel(), rows), shape=(size, size))
    matrix.sum_duplicates()
    return matrix, right


def _bending(p: int, q: int) -> float:
    """Between coefficients p, q apart along the axes, of the sum of squared second differences."""
    along = {0: 6.0, 1: -4.0, 2: 1.0}
    return (along.get(abs(p), 0.0) if q == 0 else 0.0) + (along.get(abs(q), 0.0) if p == 0 else 0.0)


def _smoothed(matrix: csr_matrix, smooth: csr_matrix) -> csr_matrix:
    weight = matrix.diagonal().mean()
    return (matrix + weight * (_SMOOTH * smooth + _RIDGE * identity(matrix.shape[0]))).tocsr()


def _fit_weights(
    encoding: Encoding, linear_skip: nn.Linear, uv: Tensor, along: Tensor, target: Tensor
) -> None:
    """Features without tables stay as they are: the linear skip's weights alone are fitted."""
    stack = value_and_jacobian_stack(encoding, uv).transpose(1, 2).double()
    features = torch.cat([stack, torch.zeros(3, 1, len(uv), dtype=stack.dtype)], dim=1)
    features[0, -1] = 1.0  # the bias
    design = _rows(features, along).transpose(0, 1).flatten(1)
    normal, right = design @ design.t(), design @ target.transpose(0, 1).flatten(1).t()
    normal += _RIDGE * normal.diagonal().mean() * torch.eye(len(normal))
    found = torch.linalg.solve(normal, right).t()
    linear_skip.weight.copy_(found[:, :-1])
    linear_skip.bias.copy_(found[:, -1])
