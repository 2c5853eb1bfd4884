"""A grid on R²/Γ whose sides are identified: the mesh of a whole closed domain."""

from __future__ import annotations

import numpy as np

from nsm.surfaces.shapes import grid_faces


def quotient_mesh(
    columns: float, rows: float, even: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A triangulated grid of the fundamental domain that closes up without a boundary.

    With the points that are one under Γ taken together, it is an oriented closed manifold mesh, of
    genus 0 if ``even`` and else of genus 1. The cones are vertices.

    Args:
        columns, rows: cells along x and y, about.
        even: whether the domain is [-1, 1] × [0, 1], of the orbifold, not the torus's [-1, 1]².

    Returns:
        points (V, 2); faces (F, 3), counter-clockwise; and for each point the vertex (V,) of the
        closed mesh that it is a copy of.
    """
    # Diagonals alternate. With these multiples all of them at a cone end there; else two of its
    # triangles would have the same three vertices.
    unit = 4 if even else 2
    n, m = max(4, unit * round(columns / unit)), max(4, 2 * round(rows / 2))
    grid = np.meshgrid(np.arange(m + 1), np.arange(n + 1), indexing="ij")
    i, j = (index.ravel() for index in grid)
    low = 0.0 if even else -1.0
    points = np.stack([-1 + 2 * j / n, low + (1 - low) * i / m], axis=1)
    column, row = j % n, i
    if even:
        # x and -x are one point on the lower side, x and 2e₂ - x on the upper
        column = np.where(i % m == 0, np.minimum(j, n - j), column)
    else:
        row = i % m
    _, origin = np.unique(row * n + column, return_inverse=True)
    return points, grid_faces(m + 1, n + 1), origin.reshape(-1)
