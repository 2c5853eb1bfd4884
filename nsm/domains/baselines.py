"""Parameterizations of libigl on the same cut mesh, for comparison side by side."""

from __future__ import annotations

import numpy as np

from nsm.domains.disc import Disc
from nsm.domains.planar_mesh import signed_areas
from nsm.domains.slim import slim
from nsm.stages import at
from nsm.surfaces import topology

SLIM_ITERATIONS = 200
ARAP_ROUNDS = 30


def free_slim(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray) -> np.ndarray:
    """SLIM with a free boundary (symmetric Dirichlet) from an injective start (V, 2)."""
    return slim(vertices, faces, start, SLIM_ITERATIONS)


def harmonic(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Harmonic map (cotangent weights) with the boundary on the circle by arc length."""
    import igl

    loop = topology.boundary_loops(faces)[0]
    circle = Disc().place_boundary(vertices, loop)
    return igl.harmonic(vertices, faces, loop, circle, 1)


def lscm(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Least squares conformal map with two far boundary vertices held; scaled to equal area."""
    import igl

    loop = topology.boundary_loops(faces)[0]
    far = int(np.linalg.norm(vertices[loop] - vertices[loop[0]], axis=1).argmax())
    held = np.array([loop[0], loop[far]], dtype=np.int64)
    uv = igl.lscm(vertices, faces, held, np.array([[0.0, 0.0], [1.0, 0.0]]))[0]
    return _equal_area(vertices, faces, uv)


def arap(vertices: np.ndarray, faces: np.ndarray, start: np.ndarray) -> np.ndarray:
    """As-rigid-as-possible map from a start (V, 2), one vertex held."""
    import igl

    data = igl.ARAPData()
    held = np.array([0], dtype=np.int32)
    igl.arap_precomputation(vertices, faces, 2, held, data)
    uv = np.ascontiguousarray(start)
    for k in range(ARAP_ROUNDS):
        at("ARAP", k, ARAP_ROUNDS)
        uv = igl.arap_solve(np.ascontiguousarray(start[held]), data, uv)
    return uv


BASELINES = {"SLIM": free_slim, "ARAP": arap, "LSCM": lscm, "harmonic": harmonic}


def _equal_area(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> np.ndarray:
    flat = np.abs(signed_areas(uv, faces)).sum()
    return uv * np.sqrt(topology.face_areas(vertices, faces).sum() / flat)
