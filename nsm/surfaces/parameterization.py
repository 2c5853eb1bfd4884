"""Injective maps of a disc-shaped mesh onto the unit disc or the square [-1,1]^2.

Tutte's embedding (uniform weights, convex boundary) comes first because it is injective whatever
the mesh. SLIM (Rabinovich et al. 2017, "Scalable Locally Injective Mappings") then lowers the
symmetric Dirichlet energy: libigl's with the boundary held, which is fast, and after it our own
steps, in which boundary vertices slide along the boundary of the domain. Our steps keep the
boundary exactly on the domain's and never accept a flipped triangle, which libigl's soft
constraints cannot promise. Large meshes are laid out coarse first
(:mod:`nsm.surfaces.multiresolution`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.multiresolution import laid_out
from nsm.surfaces.predicates import orientation

DOMAINS = ("disc", "square")
# slim_held: SLIM without the sliding steps after it, a quick look at what slim would give
METHODS = ("tutte", "slim_held", "slim")
DOMAIN_AREA = {"disc": float(np.pi), "square": 4.0}
# more faces than this are laid out coarse first
LARGE, COARSE = 40_000, 12_000
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True)
class Keys:
    """Boundary vertices (K,) that are held at fractions (K,) in [0, 1) of the way around ∂Ω.

    Both run counter-clockwise, as the boundary loop does. On the disc a fraction t is the angle
    2πt; on the square the way starts at the corner (-1, -1), and corners are at quarters.
    """

    vertices: np.ndarray
    fractions: np.ndarray


@dataclass(frozen=True)
class Parameterization:
    """uv (V,2) in the domain; medians of symmetric Dirichlet, its own and that of Tutte's embedding
    (for a mesh laid out coarse first, of the coarse one); log."""

    uv: np.ndarray
    distortion: float
    tutte_distortion: float
    log: tuple[str, ...]


def parameterize(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    domain: str = "disc",
    method: str = "slim",
    name: str = "mesh",
    keys: Keys | None = None,
) -> Parameterization:
    """Map a disc-shaped mesh (V,3), (F,3) injectively onto the domain.

    The mesh should have the area of the domain. Keys stay where they are said to be. NsmError
    for an unknown domain or method, or if even Tutte's embedding has flipped triangles in
    floating point.
    """
    if domain not in DOMAINS:
        raise NsmError(f"{name}: unknown domain '{domain}'; use one of {', '.join(DOMAINS)}")
    if method not in METHODS:
        raise NsmError(
            f"{name}: unknown parameterization '{method}'; use one of {', '.join(METHODS)}"
        )
    log: list[str] = []
    loop = topology.boundary_loops(faces)[0]
    boundary = boundary_positions(vertices, loop, domain, name, keys)
    held = np.zeros(len(vertices), dtype=bool)
    if domain == "square":
        held[loop[np.abs(boundary).min(axis=1) == 1.0]] = True
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
    return Parameterization(uv, _median_distortion(vertices, faces, uv), before, tuple(log))


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
            "floating point); give seam_vertices at the tips of long parts"
        )
    return start


def boundary_positions(
    vertices: np.ndarray,
    loop: np.ndarray,
    domain: str,
    name: str = "mesh",
    keys: Keys | None = None,
) -> np.ndarray:
    """Positions (B,2) of the boundary loop (B,) on the boundary of the domain, by arc length.

    On the square four vertices of the loop, near the quarters of its length, become the corners.
    With keys, arc length counts between neighbouring keys.
    """
    if keys is not None:
        return at_fractions(_fractions(vertices, loop, keys, domain), domain)
    points = vertices[loop]
    lengths = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    if domain == "disc":
        angle = 2 * np.pi * along[:-1] / along[-1]
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    count = len(loop)
    if count < 4:
        raise NsmError(f"{name}: the square domain needs four boundary vertices, not {count}")
    corners = [0]
    for quarter in (1, 2, 3):
        nearest = int(np.abs(along[:-1] - quarter * along[-1] / 4).argmin())
        # each side needs a vertex of its own, however uneven the boundary
        corners.append(min(max(nearest, corners[-1] + 1), count - 4 + quarter))
    result = np.empty((count, 2))
    for side, first in enumerate(corners):
        last = corners[side + 1] if side < 3 else count
        share = (along[first:last] - along[first]) / (along[last] - along[first])
        begin, end = _CORNERS[side], _CORNERS[(side + 1) % 4]
        result[first:last] = begin + share[:, None] * (end - begin)
    return result


def at_fractions(t: np.ndarray, domain: str) -> np.ndarray:
    """Points (B,2) of ∂Ω at fractions (B,) of the way around it (see :class:`Keys`)."""
    if domain == "disc":
        angle = 2 * np.pi * t
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    side = np.floor(4 * t).astype(int) % 4
    share = (4 * t - np.floor(4 * t))[:, None]
    return _CORNERS[side] + share * (_CORNERS[(side + 1) % 4] - _CORNERS[side])


def fractions_of(points: np.ndarray, domain: str) -> np.ndarray:
    """Fractions (B,) in [0, 1) of points (B,2) of ∂Ω: the inverse of :func:`at_fractions`."""
    u, v = points.T
    if domain == "disc":
        return (np.arctan2(v, u) / (2 * np.pi)) % 1.0
    sides = np.stack([-v, u, v, -u])  # each side is where one of these is 1
    along = np.stack([u, v, -u, -v])
    side = sides.argmax(axis=0)
    share = 0.5 * (along[side, np.arange(len(points))] + 1)
    return (0.25 * (side + share)) % 1.0


def _fractions(vertices: np.ndarray, loop: np.ndarray, keys: Keys, domain: str) -> np.ndarray:
    """Fractions (B,) of the loop's vertices, by arc length between neighbouring keys."""
    place = {int(v): k for k, v in enumerate(loop)}
    stops = [place[int(v)] for v in keys.vertices]
    lengths = np.linalg.norm(vertices[np.roll(loop, -1)] - vertices[loop], axis=1)
    result = np.empty(len(loop))
    for k, first in enumerate(stops):
        last = stops[(k + 1) % len(stops)]
        count = (last - first) % len(loop) or len(loop)
        run = (first + np.arange(count)) % len(loop)
        along = np.concatenate([[0.0], np.cumsum(lengths[run])])
        begin = keys.fractions[k]
        span = (keys.fractions[(k + 1) % len(stops)] - begin) % 1.0 or 1.0
        result[run] = (begin + span * along[:-1] / along[-1]) % 1.0
    if domain == "square":  # a corner without a key takes the nearest vertex that is none
        free = np.setdiff1d(np.arange(len(loop)), stops)
        for corner in (0.0, 0.25, 0.5, 0.75):
            if np.isclose(result[stops], corner, atol=1e-12).any():
                continue
            gap = np.abs((result[free] - corner + 0.5) % 1.0 - 0.5)
            result[free[gap.argmin()]] = corner
    return result


def tutte(
    vertices: np.ndarray,
    faces: np.ndarray,
    loop: np.ndarray,
    boundary: np.ndarray,
    *,
    weights: str = "uniform",
) -> np.ndarray:
    """Tutte's embedding (V,2): each inner vertex is a weighted mean of its neighbours.

    The boundary loop (B,) sits at boundary (B,2). weights: "uniform" or "mean_value"
    (Floater 2003); both are positive, so the embedding is injective in exact arithmetic.
    """
    n = len(vertices)
    if weights == "uniform":
        pairs = topology.edges_of(faces).pairs
        rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
        values = np.ones(len(rows))
    else:
        rows, columns, values = _mean_values(vertices, faces)
    matrix = csc_matrix((values, (rows, columns)), shape=(n, n))
    laplacian = (diags(np.asarray(matrix.sum(axis=1)).ravel()) - matrix).tocsr()
    inner = np.setdiff1d(np.arange(n), loop)
    uv = np.zeros((n, 2))
    uv[loop] = boundary
    if len(inner):
        right = -laplacian[inner][:, loop] @ boundary
        uv[inner] = _factorise(laplacian[inner][:, inner]).solve(right)
    return uv


def _factorise(matrix: csr_matrix) -> SuperLU:
    """LU of a positive definite matrix; pivots stay on the diagonal, or the fill would explode."""
    return splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _mean_values(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, columns, values = [], [], []
    for k in range(3):
        i, j, m = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]
        a, b = vertices[j] - vertices[i], vertices[m] - vertices[i]
        la, lb = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
        sine = np.linalg.norm(np.cross(a, b), axis=1)
        half = sine / (la * lb + (a * b).sum(axis=1)).clip(1e-12)  # tan of half the angle
        half = half.clip(1e-6, 1e6)
        rows += [i, i]
        columns += [j, m]
        values += [half / la, half / lb]
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


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


def slide(
    vertices: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    loop: np.ndarray,
    domain: str,
    steps: int,
    held: np.ndarray,
) -> np.ndarray:
    """SLIM steps from an injective uv (V,2), boundary vertices free to slide but for held (V,).

    Each step solves SLIM's weighted least-squares proxy in the remaining freedom (two coordinates
    inside, one along the boundary, none at the corners of the square), then searches along it for
    a lower symmetric Dirichlet energy without flips. Returns the last, lowest uv.
    """
    gradient, area = _gradients(vertices, faces)
    on_boundary = np.zeros(len(uv), dtype=bool)
    on_boundary[loop] = True
    inner = np.flatnonzero(~on_boundary)
    moving = loop[~held[loop]]
    energy = _energy(gradient, area, faces, uv)
    for _ in range(steps):
        direction = _proxy_step(gradient, area, faces, uv, inner, moving, domain)
        if direction is None:
            break
        # full steps flip triangles while some are needles: start short of the first to collapse
        step = min(1.0, 0.8 * _collapse_step(uv, direction, faces, inner, moving, domain))
        improved = False
        for _ in range(14):
            trial = _move(uv, direction, step, inner, moving, domain)
            value = _energy(gradient, area, faces, trial)
            if value < energy and _goes_round(trial[loop]):
                improved = True
                break
            step *= 0.6
        if not improved:
            break
        gain = (energy - value) / energy
        uv, energy = trial, value
        if gain < 1e-5:
            break
    return uv


def _gradients(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Hat function gradients (F,3,2) in a frame of each triangle, and triangle areas (F,)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    length = np.linalg.norm(b - a, axis=1)
    x = (b - a) / length[:, None]
    cx = ((c - a) * x).sum(axis=1)
    cy = np.linalg.norm((c - a) - cx[:, None] * x, axis=1)
    # corners at (0,0), (length,0), (cx,cy): cy > 0 keeps the orientation of the surface
    double = length * cy
    rotated = np.stack(
        [
            np.stack([-cy, cx - length], axis=1),
            np.stack([cy, -cx], axis=1),
            np.stack([np.zeros_like(cy), length], axis=1),
        ],
        axis=1,
    )
    return rotated / double[:, None, None], 0.5 * double


def _jacobians(gradient: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> np.ndarray:
    return np.einsum("fki,fkj->fij", uv[faces], gradient)


def _energy(gradient: np.ndarray, area: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> float:
    """Area-weighted symmetric Dirichlet energy of the map to the plane; inf with any flip."""
    if flipped_triangles(uv, faces):
        return float("inf")
    jacobian = _jacobians(gradient, faces, uv)
    determinant = np.linalg.det(jacobian)
    if (determinant <= 0).any():
        return float("inf")
    norm = (jacobian**2).sum(axis=(1, 2))
    return float((area * norm * (1 + 1 / determinant**2)).sum())


def _proxy_step(
    gradient: np.ndarray,
    area: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    inner: np.ndarray,
    moving: np.ndarray,
    domain: str,
) -> np.ndarray | None:
    """Minimiser of the proxy: steps of inner vertices (2 each, x then y), then of moving ones."""
    u, s, vt = np.linalg.svd(_jacobians(gradient, faces, uv))
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    s = s.clip(1e-14)
    u[:, :, 1] *= sign[:, None]
    rotation = u @ vt
    # weights that give the proxy the gradient of s^2 + s^-2 at this point (limit 2 at s = 1)
    # without an upper bound: cut off, the weights of needles would no longer point downhill
    near = np.abs(s - 1) < 1e-6
    weight2 = np.where(near, 4.0, (s - s**-3) / np.where(near, 1.0, s - 1)).clip(1e-8)
    w2 = np.einsum("fij,fj,fkj->fik", u, weight2, u) * area[:, None, None]
    # quadratic form in the displacement d: 1/2 d'Hd + g'd, residual (J - R) at d = 0
    residual = _jacobians(gradient, faces, uv) - rotation
    force = np.einsum("fij,fjl,fkl->fki", w2, residual, gradient)  # (F,3,2)
    dots = np.einsum("fki,fli->fkl", gradient, gradient)
    block = np.einsum("fkl,fij->fkilj", dots, w2).reshape(len(faces), 6, 6)
    n = len(uv)
    index = (faces[:, :, None] * 2 + np.arange(2)).reshape(-1, 6)
    rows = np.repeat(index, 6, axis=1).ravel()
    columns = np.tile(index, (1, 6)).ravel()
    hessian = coo_matrix((block.ravel(), (rows, columns)), shape=(2 * n, 2 * n)).tocsc()
    g = np.zeros(2 * n)
    np.add.at(g, index.ravel(), force.ravel())
    # columns of freedom: both coordinates inside, the tangent on the boundary
    tangent = _tangents(uv[moving], domain)
    k, m = len(inner), len(moving)
    freedom = coo_matrix(
        (
            np.concatenate([np.ones(2 * k), tangent.ravel()]),
            (
                np.concatenate(
                    [2 * inner, 2 * inner + 1, np.repeat(2 * moving, 2) + np.tile([0, 1], m)]
                ),
                np.concatenate([np.arange(2 * k), 2 * k + np.repeat(np.arange(m), 2)]),
            ),
        ),
        shape=(2 * n, 2 * k + m),
    ).tocsc()
    reduced = (freedom.T @ hessian @ freedom).tocsc()
    # a whisper of damping: the disc may spin freely, which leaves the proxy singular
    reduced = reduced + diags(np.full(2 * k + m, 1e-9 * reduced.diagonal().mean()))
    try:
        result = -_factorise(reduced).solve(freedom.T @ g)
    except RuntimeError:
        return None
    return result if np.isfinite(result).all() else None


def _collapse_step(
    uv: np.ndarray,
    direction: np.ndarray,
    faces: np.ndarray,
    inner: np.ndarray,
    moving: np.ndarray,
    domain: str,
) -> float:
    """The step at which the first triangle loses its area (Smith and Schaefer 2015), or inf.

    Arcs of the boundary count as their tangents, so the search may have to shorten it still.
    """
    k = len(inner)
    displacement = np.zeros_like(uv)
    displacement[inner] = direction[: 2 * k].reshape(2, k).T
    displacement[moving] = direction[2 * k :, None] * _tangents(uv[moving], domain)
    a, b, c = (uv[faces[:, i]] for i in range(3))
    da, db, dc = (displacement[faces[:, i]] for i in range(3))
    # twice the area at step t is p t^2 + q t + r with r > 0
    p = _cross(db - da, dc - da)
    q = _cross(b - a, dc - da) + _cross(db - da, c - a)
    r = _cross(b - a, c - a)
    # the smallest positive root as 2r / (sqrt(q^2 - 4pr) - q), which is stable for small p
    discriminant = q**2 - 4 * p * r
    denominator = np.sqrt(discriminant.clip(0.0)) - q
    collapses = (discriminant >= 0) & (denominator > 0)
    if not collapses.any():
        return float("inf")
    return float((2 * r[collapses] / denominator[collapses]).min())


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def _tangents(points: np.ndarray, domain: str) -> np.ndarray:
    """Unit directions (B,2) in which boundary points may slide, counter-clockwise on the disc."""
    if domain == "disc":
        return np.stack([-points[:, 1], points[:, 0]], axis=1)
    on_vertical = np.abs(points[:, 0]) > np.abs(points[:, 1])
    return np.stack([~on_vertical, on_vertical], axis=1).astype(np.float64)


def _move(
    uv: np.ndarray,
    direction: np.ndarray,
    step: float,
    inner: np.ndarray,
    moving: np.ndarray,
    domain: str,
) -> np.ndarray:
    k = len(inner)
    moved = uv.copy()
    moved[inner] += step * direction[: 2 * k].reshape(2, k).T
    along = step * direction[2 * k :]
    if domain == "disc":
        angle = np.arctan2(uv[moving, 1], uv[moving, 0]) + along
        moved[moving] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        moved[moving] = (uv[moving] + along[:, None] * _tangents(uv[moving], domain)).clip(
            -1.0, 1.0
        )
    return moved


def _goes_round(polygon: np.ndarray) -> bool:
    """Whether each side of a polygon (B,2) of ∂Ω runs counter-clockwise around the middle of Ω.

    A side over more than half of the circle would leave the middle out.
    """
    return bool((_cross(polygon, np.roll(polygon, -1, axis=0)) > 0).all())


def signed_areas(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed areas (F,) of the triangles of a flat mesh (V,2)."""
    a, b, c = (uv[faces[:, k]] for k in range(3))
    return 0.5 * (
        (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    )


def flipped_triangles(uv: np.ndarray, faces: np.ndarray) -> int:
    """Number of triangles whose signed area in the plane is not positive."""
    return int((~(signed_areas(uv, faces) > 0)).sum())


def boundary_self_intersections(uv: np.ndarray, loop: np.ndarray) -> int:
    """Number of pairs of sides of the closed polygon uv[loop] (B,2) that cross or touch.

    Neighbouring sides share a point by right and are counted only if they fold back.
    """
    p = uv[loop]
    q = np.roll(p, -1, axis=0)
    n = len(p)
    side = q - p
    following = np.roll(side, -1, axis=0)
    straight = orientation(p, q, np.roll(q, -1, axis=0)) == 0
    folded = straight & ((side * following).sum(axis=1) <= 0)
    total = int(folded.sum())
    low, high = np.minimum(p, q), np.maximum(p, q)
    for i in range(n - 2):
        last = n - 1 if i == 0 else n  # the last side is a neighbour of the first
        j = np.arange(i + 2, last)
        j = j[((low[j] <= high[i]) & (high[j] >= low[i])).all(axis=1)]
        if len(j) == 0:
            continue
        d1, d2 = orientation(p[i], q[i], p[j]), orientation(p[i], q[i], q[j])
        d3, d4 = orientation(p[j], q[j], p[i]), orientation(p[j], q[j], q[i])
        total += int(((d1 * d2 <= 0) & (d3 * d4 <= 0)).sum())
    return total


def symmetric_dirichlet_per_face(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, eps: float = 0.01
) -> np.ndarray:
    """tr(M) + tr((M + eps I)^-1) per face (F,), M = J'J of the map from uv (V,2) to 3D.

    About 4 where the map is an isometry; inf where a triangle of uv has no area.
    """
    a, b, c = (faces[:, k] for k in range(3))
    flat = np.stack([uv[b] - uv[a], uv[c] - uv[a]], axis=2)
    space = np.stack([vertices[b] - vertices[a], vertices[c] - vertices[a]], axis=2)
    determinant = flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = (
            np.stack(
                [
                    np.stack([flat[:, 1, 1], -flat[:, 0, 1]], axis=1),
                    np.stack([-flat[:, 1, 0], flat[:, 0, 0]], axis=1),
                ],
                axis=1,
            )
            / determinant[:, None, None]
        )
        jacobian = space @ inverse
        metric = np.swapaxes(jacobian, 1, 2) @ jacobian
        trace = metric[:, 0, 0] + metric[:, 1, 1]
        p, r = metric[:, 0, 0] + eps, metric[:, 1, 1] + eps
        value = trace + (p + r) / (p * r - metric[:, 0, 1] ** 2)
    return np.where(determinant != 0, value, np.inf)


def _median_distortion(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> float:
    return float(np.median(symmetric_dirichlet_per_face(vertices, faces, uv)))
