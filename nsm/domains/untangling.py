"""Local untangling: turn the few flipped triangles of a flat mesh back.

The energy is that of Garanzha et al. 2021 ("Foldover-free maps in 50 lines of code"): distortion
over a smoothed determinant, finite on flipped triangles, which drives all areas above zero. It is
minimised around each flip alone, over as many rings of triangles as necessary; the rest of the
mesh does not move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression, minimize
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from nsm.compiled import compiled
from nsm.domains.planar_mesh import flipped, signed_areas
from nsm.stages import counted
from nsm.surfaces import topology
from nsm.wording import number_of

_RINGS = (1, 2, 3, 5, 8, 13, 21, 34)
_ROUNDS, _ITERATIONS = 20, 100
# evaluations of a triangle's energy: so many for each triangle of the mesh, and the least allowed.
# Meshes of which every second triangle is flipped at random take a fifth of it
_WORK, _LEAST_WORK = 1000, 3_000_000
_SMALL = 300  # triangles: an evaluation of fewer counts as one of so many
# of the area that a triangle should have: smaller ones could flip by rounding
_ROOM = 1e-6
# of the distance of two boundary neighbours before the map: the least after it
_GAP = 0.02


@dataclass(frozen=True)
class Copies:
    """Vertices of a flat mesh that are copies of others and move with them.

    Attributes:
        first: (V,) the vertex that each is a copy of; itself if it is none.
        sign: (V,) 1 or -1, and shift: (V, 2): v lies at sign * (place of first) + shift.
        step: places of first ones are multiples of it, so that those of copies are exact; 0 for
            any places.
    """

    first: np.ndarray
    sign: np.ndarray
    shift: np.ndarray
    step: float = 0.0

    @classmethod
    def none(cls, count: int) -> Copies:
        """All of so many vertices move by themselves."""
        return cls(np.arange(count), np.ones(count), np.zeros((count, 2)))

    def rounded(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 2) to multiples of ``step``."""
        return np.rint(points / self.step) * self.step if self.step else points

    def placed(self, image: np.ndarray) -> np.ndarray:
        """The image (V, 2) with first vertices rounded and copies where these send them."""
        return self.sign[:, None] * self.rounded(image)[self.first] + self.shift


def untangled(
    rest: np.ndarray,
    faces: np.ndarray,
    image: np.ndarray,
    fixed: np.ndarray,
    copies: Copies | None = None,
) -> np.ndarray:
    """The image of a flat mesh, with its flipped triangles turned back where possible.

    Args:
        rest: (V, 2) the mesh before it is mapped, no triangle of it flipped.
        faces: (F, 3).
        image: (V, 2) where the map sends its vertices.
        fixed: (V,) mask of vertices that may not move, nor may their copies.
        copies: vertices that move with others, which ``image`` agrees with; none by default.

    Returns:
        (V, 2): ``image``, except for vertices near a flip, which follow the local affine map as
        closely as possible. The caller counts flips that remain: some do where a bounded number of
        evaluations is spent.
    """
    image = np.array(image, dtype=np.float64)
    copies = Copies.none(len(image)) if copies is None else copies
    joined = copies.first[faces]  # the triangles with each vertex by one number
    held = np.zeros(len(image), dtype=bool)
    held[copies.first[fixed]] = True
    work = max(_WORK * len(faces), _LEAST_WORK)
    for rings in _RINGS:
        bad = flipped(image, faces)
        if not bad.any() or work <= 0:
            break
        near = np.zeros(len(image), dtype=bool)
        near[joined[bad]] = True
        for _ in range(rings - 1):
            near[joined[near[joined].any(axis=1)]] = True
        free = near & ~held
        patches = _patches(joined, free, bad)
        step = f"{number_of(int(bad.sum()), 'flip')}, {number_of(rings, 'ring')} around each"
        for patch in counted(step, patches):
            if work > 0:
                work -= _solve(rest, faces[patch], image, free, copies, work)
        if near[joined].all():
            break
    return image


def _patches(faces: np.ndarray, free: np.ndarray, bad: np.ndarray) -> list[np.ndarray]:
    """The numbers (P,) of the faces around each connected group of free vertices with a flip."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[free[edges].all(axis=1)]
    n = len(free)
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    label = np.where(free, connected_components(graph, directed=False)[1], -1)
    of_face = label[faces].max(axis=1)  # the free vertices of a face are all in one group
    wanted = np.unique(of_face[bad])
    return [np.flatnonzero(of_face == group) for group in wanted[wanted >= 0].tolist()]


def _solve(
    rest: np.ndarray,
    faces: np.ndarray,
    image: np.ndarray,
    free: np.ndarray,
    copies: Copies,
    work: int,
) -> int:
    """Move free vertices of a patch (P, 3) in ``image``, if that leaves no flip in the patch, and
    say how many evaluations of a triangle it took, of ``work`` or few more."""
    vertices, number = topology.renumbered(faces, len(image))
    faces = number[faces]
    affine = _affine_fit(_sides(rest[vertices], faces), _sides(image[vertices], faces))
    if affine is None:
        return 0
    shape = rest[vertices] @ affine.T
    area = signed_areas(shape, faces)
    if not (area > 0).all():
        return 0
    inverse = _cofactors(_sides(shape, faces)).transpose(0, 2, 1) / (2 * area[:, None, None])
    first = copies.first[vertices]
    moving = np.unique(first[free[first]])
    which = np.where(free[first], np.searchsorted(moving, first), -1)
    sign, shift = copies.sign[vertices], copies.shift[vertices]
    trial = image[vertices]

    def least_determinant() -> float:
        return float((signed_areas(trial, faces) / area).min())

    least, x = least_determinant(), image[moving]
    size, spent = max(len(faces), _SMALL), 0
    for _ in range(_ROUNDS):
        if spent >= work:
            break
        # Escobar et al. 2003: enough smoothing to pull at the worst, and less as it gets better
        epsilon = np.sqrt(1e-12 + 0.04 * min(least, 0.0) ** 2)

        def energy(x: np.ndarray, epsilon: float = epsilon) -> tuple[float, np.ndarray]:
            _place(x.reshape(-1, 2), which, sign, shift, trial)
            gradient = np.zeros((len(moving), 2))
            value = _energy(trial, faces, inverse, epsilon, which, sign, gradient)
            return value, gradient.ravel()

        found = minimize(
            energy,
            x.ravel(),
            jac=True,
            method="L-BFGS-B",
            options={
                "maxiter": _ITERATIONS,
                "maxcor": 20,
                "maxfun": 1 + (work - spent) // size,
            },
        )
        spent += size * int(found.nfev)
        if not np.isfinite(found.x).all():
            break
        x = copies.rounded(found.x.reshape(-1, 2))
        _place(x, which, sign, shift, trial)
        least = least_determinant()
        if least > _ROOM and not flipped(trial, faces).any():
            image[moving] = x
            image[vertices] = trial
            break
    return spent


def _affine_fit(before: np.ndarray, after: np.ndarray) -> np.ndarray | None:
    """The least-squares linear map (2, 2) between sides (F, 2, 2), or None if it reflects."""
    x, y = (sides.transpose(0, 2, 1).reshape(-1, 2) for sides in (before, after))
    matrix = np.linalg.lstsq(x, y, rcond=None)[0].T
    return matrix if np.linalg.det(matrix) > 0 else None


def _sides(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Matrices (F, 2, 2) whose columns are two sides of each triangle."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.stack([b - a, c - a], axis=2)


def _cofactors(matrices: np.ndarray) -> np.ndarray:
    """The derivatives (F, 2, 2) of determinants by the entries of matrices (F, 2, 2)."""
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    return np.stack([np.stack([d, -c], axis=1), np.stack([-b, a], axis=1)], axis=1)


@compiled
def _place(
    x: np.ndarray, which: np.ndarray, sign: np.ndarray, shift: np.ndarray, points: np.ndarray
) -> None:
    """Put points (V, 2) where the ones that they follow are, at x (N, 2); which (V,) they are, -1
    for points that stay."""
    for v in range(len(points)):
        if which[v] >= 0:
            for i in range(2):
                points[v, i] = sign[v] * x[which[v], i] + shift[v, i]


@compiled
def _energy(
    points: np.ndarray,
    faces: np.ndarray,
    inverse: np.ndarray,
    epsilon: float,
    which: np.ndarray,
    sign: np.ndarray,
    gradient: np.ndarray,
) -> float:
    """Σ (‖J‖² + det² + 1) / χ(det) over the triangles (F, 3) with vertices at points (V, 2); its
    derivatives by those that the points follow are added to the gradient (N, 2).

    χ(d) = (d + √(ε² + d²)) / 2 is positive, whatever d is.
    """
    energy = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        p, q = points[b, 0] - points[a, 0], points[c, 0] - points[a, 0]
        r, s = points[b, 1] - points[a, 1], points[c, 1] - points[a, 1]
        bx, by, cx, cy = inverse[f, 0, 0], inverse[f, 0, 1], inverse[f, 1, 0], inverse[f, 1, 1]
        xx, xy, yx, yy = p * bx + q * cx, p * by + q * cy, r * bx + s * cx, r * by + s * cy
        d = xx * yy - xy * yx
        root = np.sqrt(epsilon * epsilon + d * d)
        # for d < 0 the difference would cancel
        chi = 0.5 * (d + root) if d > 0 else 0.5 * epsilon * epsilon / (root - d)
        top = xx * xx + xy * xy + yx * yx + yy * yy + d * d + 1
        energy += top / chi
        by_d = (2 * d - top / root) / chi
        # by the Jacobian
        gxx, gxy = 2 * xx / chi + by_d * yy, 2 * xy / chi - by_d * yx
        gyx, gyy = 2 * yx / chi - by_d * xy, 2 * yy / chi + by_d * xx
        _add(
            gradient,
            which[a],
            sign[a],
            -gxx * (bx + cx) - gxy * (by + cy),
            -gyx * (bx + cx) - gyy * (by + cy),
        )
        _add(gradient, which[b], sign[b], gxx * bx + gxy * by, gyx * bx + gyy * by)
        _add(gradient, which[c], sign[c], gxx * cx + gxy * cy, gyx * cx + gyy * cy)
    return energy


@compiled
def _add(gradient: np.ndarray, number: int, sign: float, x: float, y: float) -> None:
    """Add a derivative to those of a point, if it is one that moves."""
    if number >= 0:
        gradient[number, 0] += sign * x
        gradient[number, 1] += sign * y


def order_shifts(now: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far the points of a loop must move along a closed curve to be in order.

    The nearest increasing fractions (isotonic regression) keep distances of at least a small share
    of those before the map.

    Args:
        now: (B,) fractions of the way around, where a map sends the loop's vertices.
        before: (B,) rising fractions before the map.

    Returns:
        which points (M,) move, and their shifts (M,); none where the loop does not go around once.
    """
    gap = _GAP * np.mod(np.roll(before, -1) - before, 1.0)
    step = np.mod(np.roll(now, -1) - now + 0.5, 1.0) - 0.5
    if round(step.sum()) != 1:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    # how far around each point is, less the gaps, should not decrease; over three turns
    turn = 1.0 - gap.sum()
    once = np.concatenate([[0.0], np.cumsum(step - gap)[:-1]])
    along = np.concatenate([once - turn, once, once + turn])
    # the circle is opened at a point ahead of all before it and behind all after it
    highest = np.maximum.accumulate(along)
    lowest = np.minimum.accumulate(along[::-1])[::-1]
    n = len(now)
    first = int(np.argmin((highest - lowest)[n : 2 * n]))
    piece = along[n + first : 2 * n + first]
    better = isotonic_regression(piece).x.clip(piece[0], piece[0] + turn)
    moved = better != piece
    return (first + np.flatnonzero(moved)) % n, (better - piece)[moved]
