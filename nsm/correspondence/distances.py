"""Geodesic distances along the edges of a mesh."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import dijkstra

from nsm.surfaces.geometry import edge_graph


def edge_distances(
    vertices: np.ndarray, faces: np.ndarray, sources: np.ndarray | None = None
) -> np.ndarray:
    """Lengths (S, V) of shortest paths along edges, from sources (S,) or from all vertices."""
    return np.asarray(dijkstra(edge_graph(vertices, faces), directed=False, indices=sources))
