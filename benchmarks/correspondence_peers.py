"""Peers of the benchmark of correspondences: functional maps, and iterated closest points.

They need nsm[peers]: pyfmaps, the authors' package of functional maps and ZoomOut (Melzi et al.
2019, "ZoomOut: spectral upsampling for efficient shape correspondence").
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from nsm.correspondence.search import pose
from nsm.domains.orbifold.cones import decimated
from nsm.surfaces.topology import face_areas

_FACES = 3000
_ITERATIONS = 30  # of closest points
_FIRST, _LAST, _STEP = 20, 100, 5  # eigenfunctions of ZoomOut


def zoomout_map(
    source: np.ndarray,
    source_faces: np.ndarray,
    target: np.ndarray,
    target_faces: np.ndarray,
    vertices: np.ndarray,
) -> np.ndarray:
    """Points (K, 3) of the target for vertices (K,) of the source: wave kernel signatures, terms of
    commutation and orientation, then ZoomOut."""
    from pyFM.functional import FunctionalMapping

    (ours, s), (theirs, t) = _both(source, source_faces, target, target_faces, vertices)
    model = FunctionalMapping(t, s)  # its point-wise map goes from the second to the first
    model.preprocess(n_descr=100, descr_type="WKS", subsample_step=5, k_process=_LAST + 1)
    model.fit(K=(_FIRST, _FIRST), w_descr=1.0, w_lap=1e-2, w_dcomm=1e-1, w_orient=1e-1)
    model.zoomout_refine(nit=(_LAST - _FIRST) // _STEP, step=_STEP)
    nearest = model.get_p2p()
    return np.asarray(t.vertices)[nearest[np.searchsorted(ours, vertices)]] * theirs[1] + theirs[0]


def icp_map(
    source: np.ndarray,
    source_faces: np.ndarray,
    target: np.ndarray,
    target_faces: np.ndarray,
    vertices: np.ndarray,
) -> np.ndarray:
    """The same by iterated closest points, the best of 24 rotations, then ZoomOut."""
    from pyFM.refine.zoomout import mesh_zoomout_refine_p2p

    (ours, s), (theirs, t) = _both(source, source_faces, target, target_faces, vertices)
    p, q = np.asarray(s.vertices), np.asarray(t.vertices)
    nearest = _closest(p, q)
    for mesh in (s, t):
        mesh.process(k=_LAST + 1)
    count = (_LAST - _FIRST) // _STEP
    _, refined = mesh_zoomout_refine_p2p(
        nearest, t, s, k_init=_FIRST, nit=count, step=_STEP, return_p2p=True
    )
    return q[refined[np.searchsorted(ours, vertices)]] * theirs[1] + theirs[0]


def _closest(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Numbers (N,) of the points q nearest to points p (N, 3) after the best rigid motion found."""
    tree = cKDTree(q)
    best, found = np.inf, np.zeros(len(p), dtype=np.int64)
    for turn in Rotation.create_group("O").as_matrix():
        moved = p @ turn
        for _ in range(_ITERATIONS):
            nearest = tree.query(moved)[1]
            matched = q[nearest]
            turn_more = pose(moved, matched)
            moved = (moved - moved.mean(axis=0)) @ turn_more + matched.mean(axis=0)
        distance, nearest = tree.query(moved)
        if (distance**2).mean() < best:
            best, found = float((distance**2).mean()), nearest
    return np.asarray(found)


def _both(
    source: np.ndarray,
    source_faces: np.ndarray,
    target: np.ndarray,
    target_faces: np.ndarray,
    vertices: np.ndarray,
) -> tuple:
    """Of both shapes, on fewer triangles: (the source's vertices that are left, its mesh), and
    ((the target's mean, its scale), its mesh), about their means with area one."""
    from pyFM.mesh import TriMesh

    result = []
    for points, faces, held in ((source, source_faces, vertices), (target, target_faces, None)):
        coarse, ids = decimated(points, faces, _FACES, held)
        chosen = points[ids]
        scale = np.sqrt(face_areas(chosen, coarse).sum())
        mean = chosen.mean(axis=0)
        mesh = TriMesh((chosen - mean) / scale, coarse)
        result.append((ids if held is not None else (mean, scale), mesh))
    return tuple(result)
