"""A periodic spline fitted to a laid-out closed surface by least squares: a start for φ."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags, kron
from scipy.sparse import eye as identity

from nsm.domains.orbifold.embedding import Embedding
from nsm.domains.orbifold.maps import EvenMap, PeriodicSplineGrid
from nsm.domains.orbifold.tutte import factorised
from nsm.surfaces import topology

# Barycentric places of a triangle's samples: its corners, the middles of its sides, its own.
_PLACES = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [4, 4, 1], [1, 4, 4], [4, 1, 4], [3, 3, 3]], dtype=float
)
_PLACES /= _PLACES.sum(axis=1, keepdims=True)


def resolution_for(lattice: np.ndarray, cells: int) -> tuple[int, int]:
    """Cells (N₁, N₂) along both axes, about ``cells`` in all, square where the plane is that of
    the lattice (2, 2); both even."""
    long, short = np.linalg.norm(lattice, axis=0)
    n = np.sqrt(cells * long / short)
    return max(4, 2 * round(n / 2)), max(4, 2 * round(cells / n / 2))


def fitted_spline(
    embedding: Embedding,
    vertices: np.ndarray,
    resolution: int | tuple[int, int] = 64,
    smoothness: float = 1e-6,
) -> EvenMap | PeriodicSplineGrid:
    """The periodic quadratic spline nearest to a surface, even on an orbifold.

    Least squares over samples of each triangle, weighted by area on the surface, with the squared
    second differences of the coefficients for a regulariser.

    Args:
        embedding: of the mesh.
        vertices: (V, 3).
        resolution: cells along both axes.
        smoothness: weight of the regulariser, relative to the data's.

    Returns:
        a map from points (N, 2) of Ω to (N, 3), in double precision: an :class:`EvenMap` of one
        grid, or the grid itself on a torus.
    """
    size = (resolution, resolution) if isinstance(resolution, int) else resolution
    at, target, weight = _samples(embedding, vertices)
    basis = spline_basis(at, size)
    even = embedding.cones is not None
    fold = _folding(size, even)
    basis = (basis @ fold).tocsr()
    normal = (basis.T @ diags(weight) @ basis).tocsc()
    rough = fold.T @ _second_differences(size) @ fold
    scale = normal.diagonal().sum() / rough.diagonal().sum()
    system = csc_matrix(
        normal
        + smoothness * scale * rough
        + 1e-12 * normal.diagonal().mean() * identity(normal.shape[0])
    )
    coefficients = fold @ factorised(system).solve(basis.T @ (weight[:, None] * target))
    grid = PeriodicSplineGrid([size], features=target.shape[1]).double()
    # g(x) + g(-x) is twice g, if g is even
    grid.tables[0].data = torch.from_numpy(coefficients * (0.5 if even else 1.0))
    return EvenMap(grid) if even else grid


def spline_basis(at: np.ndarray, size: tuple[int, int]) -> csr_matrix:
    """Values (N, N₁ N₂) of the periodic quadratic B-splines at points (N, 2) of Ω."""
    turns = 0.5 * at
    t = (turns - np.floor(turns)) * size
    cell = np.minimum(np.floor(t), np.array(size) - 1)
    f = t - cell
    s = 1 - f
    w = np.stack([0.5 * s * s, 0.5 + f * s, 0.5 * f * f], axis=2)
    index = np.mod(cell.astype(np.int64)[:, :, None] + np.arange(-1, 2), np.array(size)[:, None])
    columns = index[:, 0, :, None] * size[1] + index[:, 1, None, :]
    values = w[:, 0, :, None] * w[:, 1, None, :]
    rows = np.arange(0, 9 * len(at) + 1, 9)
    shape = (len(at), size[0] * size[1])
    return csr_matrix((values.ravel(), columns.ravel(), rows), shape=shape)


def _samples(
    embedding: Embedding, vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    corner, faces = embedding.corners(), embedding.faces
    at = np.einsum("pk,fki->fpi", _PLACES, corner).reshape(-1, 2)
    target = np.einsum("pk,fki->fpi", _PLACES, vertices[faces]).reshape(-1, vertices.shape[1])
    area = topology.face_areas(vertices, faces)
    weight = np.repeat(area / area.sum() / len(_PLACES), len(_PLACES))
    return at, target, weight


def _folding(size: tuple[int, int], even: bool) -> csr_matrix:
    """Coefficients (N₁ N₂) from those that are free (K): all, or one of each pair under x → -x."""
    i, j = np.divmod(np.arange(size[0] * size[1]), size[1])
    own = i * size[1] + j
    other = np.mod(-1 - i, size[0]) * size[1] + np.mod(-1 - j, size[1])
    first = np.minimum(own, other) if even else own
    free, number = np.unique(first, return_inverse=True)
    ones = np.ones(len(own))
    return coo_matrix((ones, (own, number)), shape=(len(own), len(free))).tocsr()


def _second_differences(size: tuple[int, int]) -> csr_matrix:
    one = []
    for n in size:
        row = np.arange(n)
        d = csr_matrix(
            (
                np.tile([1.0, -2.0, 1.0], n),
                (np.repeat(row, 3), np.stack([(row - 1) % n, row, (row + 1) % n], axis=1).ravel()),
            ),
            shape=(n, n),
        )
        one.append(d.T @ d)
    return (kron(one[0], identity(size[1])) + kron(identity(size[0]), one[1])).tocsr()


def rms_error(surface: torch.nn.Module, embedding: Embedding, vertices: np.ndarray) -> float:
    """Root mean square distance of a map φ to the mesh at matching points, by area, in percent of
    the diagonal of the bounding box."""
    at, target, weight = _samples(embedding, vertices)
    with torch.no_grad():
        value = np.concatenate(
            [
                surface(torch.from_numpy(part)).numpy()
                for part in np.array_split(at, 1 + len(at) // 50000)
            ]
        )
    square = weight @ ((value - target) ** 2).sum(axis=1)
    used = vertices[np.unique(embedding.faces)]
    return 100 * float(np.sqrt(square) / np.linalg.norm(np.ptp(used, axis=0)))
