"""Injective maps of a disc-shaped mesh onto the unit disc or the square [-1,1]^2.

Tutte's embedding (uniform weights, convex boundary) comes first because it is injective whatever
the mesh. SLIM (Rabinovich et al. 2017, "Scalable Locally Injective Mappings") then lowers the
symmetric Dirichlet energy: libigl's with the boundary held, which is fast, and after it our own
steps, in which boundary vertices slide along the boundary of the domain. Our steps keep the
boundary exactly on the domain's and never accept a flipped triangle, which libigl's soft
constraints cannot promise. Large meshes are laid out coarse first
(:mod:`nsm.domains.coarse_to_fine`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.coarse_to_fine import laid_out
from nsm.domains.planar_mesh import boundary_self_intersections, flipped_triangles
from nsm.domains.sliding import slide
from nsm.domains.tutte import tutte
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.geometry import triangle_distortion

if TYPE_CHECKING:
    from nsm.domains.base import BoundedDomain, Keys

# slim_held: SLIM without the sliding steps after it, a quick look at what slim would give
METHODS = ("tutte", "slim_held", "slim")
# more faces than this are laid out coarse first
LARGE, COARSE = 40_000, 12_000


@dataclass(frozen=True)
class Embedding:
    """uv (V,2) in the domain; medians of symmetric Dirichlet, its own and that of Tutte's embedding
    (for a mesh laid out coarse first, of the coarse one); log."""

    uv: np.ndarray
    distortion: float
    tutte_distortion: float
    log: tuple[str, ...]


def embed(
    domain: BoundedDomain,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    method: str = "slim",
    name: str = "mesh",
    keys: Keys | None = None,
) -> Embedding:
    """Map a disc-shaped mesh (V,3), (F,3) injectively onto the domain.

    The mesh should have the area of the domain. Keys stay in their places.

    Raises:
        NsmError: ``unknown_option``, an unknown method; ``not_injective``, even Tutte's embedding
            has flipped triangles in floating point.
    """
    check_method(method, name)
    log: list[str] = []
    loop = topology.boundary_loops(faces)[0]
    boundary = domain.place_boundary(vertices, loop, name, keys)
    held = np.zeros(len(vertices), dtype=bool)
    held[loop[domain.at_corner(boundary)]] = True
    if keys is not None:
        held[keys.vertices] = True

    before = float("nan")

    def solve(
        points: np.ndarray,
        triangles: np.ndarray,
        rim: np.ndarray,
        at: np.ndarray,
        stay: np.ndarray,
    ) -> np.ndarray:
        nonlocal before
        start = _start(points, triangles, rim, at, name, log)
        before = _median_distortion(points, triangles, start)
        if method == "tutte":
            return start
        uv = _slim_held(points, triangles, start, rim, at, log)
        steps = _sliding_steps(len(triangles)) if method == "slim" else 0
        uv = slide(points, triangles, uv, rim, domain, steps, stay)
        if flipped_triangles(uv, triangles) or boundary_self_intersections(uv, rim):
            log.append("SLIM result was not injective: Tutte's embedding kept")
            return start
        return uv

    uv = None
    if method != "tutte" and len(faces) > LARGE:
        uv = laid_out(vertices, faces, loop, boundary, domain, held, solve, COARSE)
        if uv is not None and (
            flipped_triangles(uv, faces) or boundary_self_intersections(uv, loop)
        ):
            uv = None
        if uv is None:
            log[:] = ["a coarse mesh's layout did not carry over: laid out at once"]
    if uv is None:
        uv = solve(vertices, faces, loop, boundary, held)
    return Embedding(uv, _median_distortion(vertices, faces, uv), before, tuple(log))


def check_method(method: str, name: str) -> None:
    """NsmError for a method that is none of :data:`METHODS`."""
    if method not in METHODS:
        raise NsmError(
            f"{name}: unknown parameterization {method!r}; use one of {', '.join(METHODS)}",
            kind="unknown_option",
            key="parameterization",
        )


def _start(
    vertices: np.ndarray,
    faces: np.ndarray,
    loop: np.ndarray,
    boundary: np.ndarray,
    name: str,
    log: list[str],
) -> np.ndarray:
    """Tutte's embedding (V,2), checked; NsmError if it has flips."""
    start = tutte(vertices, faces, loop, boundary)
    if flipped_triangles(start, faces):
        start = tutte(vertices, faces, loop, boundary, weights="mean_value")
        log.append("uniform Tutte weights lost precision: mean value weights used")
    flipped = flipped_triangles(start, faces)
    if flipped:
        raise NsmError(
            f"{name}: {flipped} triangles flip in Tutte's embedding (parts too long and thin for "
            "floating point); give seam_vertices at the tips of long parts",
            kind="not_injective",
            key=name,
        )
    return start


def _slim_held(
    vertices: np.ndarray,
    faces: np.ndarray,
    start: np.ndarray,
    loop: np.ndarray,
    boundary: np.ndarray,
    log: list[str],
) -> np.ndarray:
    """libigl's SLIM with the boundary held softly, brought back to the boundary without flips."""
    import igl

    iterations = 30 if len(faces) < 40_000 else 12
    bc = np.zeros((len(loop), 2))
    bc[:] = boundary
    try:
        data = igl.slim_precompute(
            np.asfortranarray(vertices, dtype=np.float64),
            np.asfortranarray(faces, dtype=np.int32),
            np.asfortranarray(start, dtype=np.float64),
            igl.SYMMETRIC_DIRICHLET,
            loop.astype(np.int32),
            np.asfortranarray(bc),
            1e5,
        )
        solved = np.array(igl.slim_solve(data, iterations))[:, :2]
    except RuntimeError as error:
        log.append(f"libigl SLIM failed ({error}): sliding steps start from Tutte's embedding")
        return start
    solved[loop] = boundary
    # Any point on the way from Tutte's embedding is as good a start as it has no flips.
    share = 1.0
    for _ in range(12):
        blend = start + share * (solved - start)
        if np.isfinite(blend).all() and not flipped_triangles(blend, faces):
            return blend
        share *= 0.7
    return start


def _sliding_steps(n_faces: int) -> int:
    """How many sliding steps a mesh gets, so that time stays within seconds."""
    return int(np.clip(800_000 / n_faces, 6, 60))


def _median_distortion(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> float:
    return float(np.median(triangle_distortion(uv, vertices, faces)))
