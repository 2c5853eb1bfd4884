"""Injective layouts of a disc-shaped mesh over a domain with a convex boundary.

Tutte's embedding comes first: with uniform weights and a convex boundary it is injective for every
mesh. SLIM (Rabinovich et al. 2017, "Scalable Locally Injective Mappings") then lowers the symmetric
Dirichlet energy (:mod:`nsm.domains.sliding`), first with a fixed boundary, then with one that
slides along ∂Ω. Large meshes, and those whose long thin parts exceed floating point in Tutte's
embedding, are laid out coarse to fine (:mod:`nsm.domains.coarse_to_fine`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.coarse_to_fine import embed_coarse_to_fine
from nsm.domains.planar_mesh import boundary_self_intersections, flipped_triangles
from nsm.domains.sliding import slide
from nsm.domains.tutte import tutte
from nsm.errors import NsmError
from nsm.stages import at
from nsm.surfaces import topology
from nsm.surfaces.geometry import triangle_distortion
from nsm.wording import number_of

if TYPE_CHECKING:
    from nsm.domains.base import BoundedDomain, Keys

# slim_held: SLIM with a fixed boundary, a fast estimate of slim
METHODS = ("tutte", "slim_held", "slim")
GIVEN = "given"  # texture coordinates of the mesh file (:mod:`nsm.domains.given_layout`)
# meshes with more faces than LARGE are first decimated to COARSE faces
LARGE, COARSE = 40_000, 12_000
MOST_HELD = 30  # steps with a fixed boundary
FEWER = 8  # a mesh whose Tutte embedding flips triangles is decimated by this factor, or again


@dataclass(frozen=True)
class Embedding:
    """A layout over Ω.

    Attributes:
        uv: (V, 2) in Ω.
        distortion: median symmetric Dirichlet energy of the map from Ω to the mesh.
        tutte_distortion: that of Tutte's embedding, of the coarse mesh if there was one.
        log: fallbacks taken, a line each.
    """

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
        NsmError: ``unknown_option``, an unknown method; ``not_injective``, Tutte's embedding has
            flipped triangles in floating point, that of a decimated mesh too.
    """
    check_method(method, name)
    log: list[str] = []
    loop = topology.boundary_loops(faces)[0]
    boundary = domain.place_boundary(vertices, loop, name, keys)
    held = np.zeros(len(vertices), dtype=bool)
    held[loop[domain.at_corner(boundary)]] = True
    if keys is not None:
        held[keys.vertices] = True

    tutte_distortion = float("nan")

    def solve(
        vertices: np.ndarray,
        faces: np.ndarray,
        loop: np.ndarray,
        boundary: np.ndarray,
        held: np.ndarray,
    ) -> np.ndarray:
        nonlocal tutte_distortion
        at("Tutte's embedding")
        start = _tutte_start(vertices, faces, loop, boundary, name, log)
        tutte_distortion = _median_distortion(vertices, faces, start)
        if method == "tutte":
            return start
        steps = _steps(len(faces))
        whole = np.zeros_like(held)
        whole[loop] = True
        uv = slide(vertices, faces, start, loop, domain, min(steps, MOST_HELD), whole)
        if method == "slim":
            uv = slide(vertices, faces, uv, loop, domain, steps, held)
        if _is_injective(uv, faces, loop):
            return uv
        log.append("SLIM's result was not injective: Tutte's embedding kept")
        return start

    def solve_coarse_to_fine(count: int) -> np.ndarray | None:
        uv = embed_coarse_to_fine(vertices, faces, loop, boundary, domain, held, solve, count)
        return uv if uv is not None and _is_injective(uv, faces, loop) else None

    uv = None
    if method != "tutte" and len(faces) > LARGE:
        uv = solve_coarse_to_fine(COARSE)
        if uv is None:
            log[:] = ["coarse-to-fine layout failed: whole mesh laid out at once"]
    if uv is None:
        try:
            uv = solve(vertices, faces, loop, boundary, held)
        except NsmError:
            if method == "tutte":
                raise
            # the fewer triangles along a thin part, the better floating point tells them apart
            uv = _first_that_succeeds(solve_coarse_to_fine, len(faces))
            if uv is None:
                raise
            log[:] = ["long thin parts exceed floating point in Tutte's embedding: coarse to fine"]
    distortion = _median_distortion(vertices, faces, uv)
    return Embedding(uv, distortion, tutte_distortion, tuple(log))


def _first_that_succeeds(
    solve_coarse_to_fine: Callable[[int], np.ndarray | None], count: int
) -> np.ndarray | None:
    """The layout of the finest coarse mesh that has one."""
    while (count := count // FEWER) > FEWER:
        try:
            uv = solve_coarse_to_fine(count)
        except NsmError:
            continue
        if uv is not None:
            return uv
    return None


def _is_injective(uv: np.ndarray, faces: np.ndarray, loop: np.ndarray) -> bool:
    return not (flipped_triangles(uv, faces) or boundary_self_intersections(uv, loop))


def check_method(method: str, name: str) -> None:
    """NsmError for a method that is none of :data:`METHODS`, nor ``given``."""
    if method not in (*METHODS, GIVEN):
        raise NsmError(
            f"{name}: unknown parameterization {method!r}; use one of {', '.join(METHODS)}",
            kind="unknown_option",
            key="parameterization",
        )


def _tutte_start(
    vertices: np.ndarray,
    faces: np.ndarray,
    loop: np.ndarray,
    boundary: np.ndarray,
    name: str,
    log: list[str],
) -> np.ndarray:
    """Tutte's embedding (V,2) without flips, or NsmError."""
    start = tutte(vertices, faces, loop, boundary)
    if flipped_triangles(start, faces):
        start = tutte(vertices, faces, loop, boundary, weights="mean_value")
        log.append("uniform Tutte weights lost precision: mean value weights used")
    flipped = flipped_triangles(start, faces)
    if flipped:
        raise NsmError(
            f"{name}: Tutte's embedding flips {number_of(flipped, 'triangle')}, as long thin parts "
            "exceed floating point; give seam_vertices at the tips of long parts",
            kind="not_injective",
            key=name,
        )
    return start


def _steps(n_faces: int) -> int:
    """Number of SLIM's steps, such that they take about a second."""
    return int(np.clip(2_000_000 / n_faces, 15, 150))


def _median_distortion(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> float:
    return float(np.median(triangle_distortion(uv, vertices, faces)))
