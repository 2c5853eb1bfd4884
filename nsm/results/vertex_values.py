"""Values at the vertices of a mesh file, and of the cut mesh prepared from it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import csr_matrix

from nsm.domains import Surface
from nsm.errors import NsmError


def by_file_vertex(surface: Surface, values: np.ndarray) -> np.ndarray:
    """Values at the cut mesh's vertices (V, ...) as values at the mesh file's (W, ...).

    A seam vertex takes the value of its first copy, a merged vertex that of the vertex it was
    merged with, and a vertex that is not on the surface that of the one with the nearest number.
    """
    row = surface.cut_vertex
    present = np.flatnonzero(row >= 0)
    nearest = present[np.searchsorted(present, np.arange(len(row))).clip(max=len(present) - 1)]
    return values[row[nearest]]


def mean_by_file_vertex(surface: Surface, values: np.ndarray) -> np.ndarray:
    """As :func:`by_file_vertex`, with the mean over all copies of a seam vertex."""
    known = np.flatnonzero(surface.source_vertex >= 0)
    vertex = surface.source_vertex[known]
    total = np.zeros((len(surface.cut_vertex), *values.shape[1:]))
    np.add.at(total, vertex, values[known])
    count = np.bincount(vertex, minlength=len(total))
    mean = total / np.maximum(count, 1).reshape(-1, *[1] * (values.ndim - 1))
    # what was merged, or is not on the surface, takes the value of another vertex
    return mean[by_file_vertex(surface, surface.source_vertex)]


def on_cut_mesh(surface: Surface, values: np.ndarray) -> np.ndarray:
    """Values at the mesh file's vertices (W, ...) as values at the cut mesh's (V, ...).

    Vertices that were inserted between others take the mean of their neighbours, or a label of one.

    Raises:
        NsmError: ``wrong_shape``: not a row for each vertex of the file.
    """
    needed = len(surface.cut_vertex)
    if values.ndim == 0 or len(values) != needed:
        rows = 0 if values.ndim == 0 else len(values)
        message = f"{surface.name} has {needed} vertices, but {rows} rows were given"
        raise NsmError(message, kind="wrong_shape", key=surface.name)
    result = values[np.maximum(surface.source_vertex, 0)]
    whole = np.issubdtype(values.dtype, np.integer) or values.dtype == bool
    for vertex, around in _inserted(surface):
        result[vertex] = result[around[0]] if whole else result[around].mean(axis=0)
    return result


def cut_mesh_matrix(surface: Surface) -> csr_matrix:
    """What :func:`on_cut_mesh` does to numbers, as a matrix (V, W)."""
    known = np.flatnonzero(surface.source_vertex >= 0)
    rows, columns, weights = [known], [surface.source_vertex[known]], [np.ones(len(known))]
    for vertex, around in _inserted(surface):
        rows.append(np.full(len(around), vertex))
        columns.append(surface.source_vertex[around])
        weights.append(np.full(len(around), 1 / len(around)))
    entries = (np.concatenate(rows), np.concatenate(columns))
    shape = (len(surface.vertices), len(surface.cut_vertex))
    return csr_matrix((np.concatenate(weights), entries), shape=shape)


def _inserted(surface: Surface) -> Iterator[tuple[int, np.ndarray]]:
    """Each vertex that was inserted between others, and its neighbours (N,) of the mesh file."""
    for vertex in np.flatnonzero(surface.source_vertex < 0).tolist():
        around = np.unique(surface.faces[(surface.faces == vertex).any(axis=1)])
        yield vertex, around[surface.source_vertex[around] >= 0]
