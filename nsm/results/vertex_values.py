"""Values at the vertices of a mesh file, and of the cut mesh prepared from it."""

from __future__ import annotations

import numpy as np

from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.wording import number_of


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


def check_rows(surface: Surface, values: np.ndarray) -> None:
    """Refuse values that have not a row for each vertex of the mesh file.

    Raises:
        NsmError: ``wrong_shape``.
    """
    needed = len(surface.cut_vertex)
    if values.ndim == 0 or len(values) != needed:
        rows = 0 if values.ndim == 0 else len(values)
        message = f"{surface.name} has {needed} vertices; given: {number_of(rows, 'row')}"
        raise NsmError(message, kind="wrong_shape", key=surface.name)
