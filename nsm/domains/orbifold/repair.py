"""Repair of maps of closed domains, in the cover: copies made exact, flips turned back.

An equivariant map h of R²/Γ is h(x) = Bx + c but for a function of Ω, with B in SL(2, Z), and c
any point on the torus, an integer point on the orbifold. For an element γx = sx + 2k of Γ,
h(γx) = γ'h(x) with γ'y = sy + 2Bk + (1 - s)c. A surface's vertices are in the plane with a copy for
each lift that a triangle needs, so images of copies are not free. If they agree exactly with one
(B, c), all cones are at their points and no triangle is flipped, the map is locally a homeomorphism
of Ω; its degree is det B.
"""

from __future__ import annotations

import math

import numpy as np

from nsm.domains.orbifold import group
from nsm.domains.orbifold.embedding import SIDE
from nsm.domains.reinsertion import turned_back
from nsm.domains.untangling import Copies

# coordinates of Ω are rounded to multiples of this; points above 64 to coarser ones
_STEP, _DIGITS = SIDE * group.STEP, 52


def copied(rest: np.ndarray, pairs: np.ndarray, image: np.ndarray, even: bool) -> np.ndarray:
    """The image with copies of a vertex where the vertex's own image sends them, exactly.

    Args:
        rest: (V, 2) the vertices in the plane.
        pairs: (T, 2) vertices that are first and other copies of one point.
        image: (V, 2) images under an equivariant map, but for rounding.
        even: whether x and -x are one point: the orbifold. Its cones are sent to lattice points.

    Returns:
        (V, 2), rounded so that lifts are exact in double precision.
    """
    image = _with_cones(rest, pairs, image, even)
    return _copies(rest, pairs, image, even).placed(image)


def torn(rest: np.ndarray, pairs: np.ndarray, image: np.ndarray, even: bool) -> int:
    """How many pairs of copies have images that are not exactly lifts of one point, as the map's
    isotopy class wants them, and how many cones are not at their lattice points.

    Args:
        rest, pairs, image, even: as for :func:`copied`.
    """
    first, other = np.asarray(pairs, dtype=np.int64).reshape(-1, 2).T
    copies = _copies(rest, pairs, image, even)
    sign, shift = copies.sign[other, None], copies.shift[other]
    # a rounded sum that is also right backwards is exact
    there = sign * image[first] + shift == image[other]
    back = sign * (image[other] - shift) == image[first]
    wrong = int((~(there & back)).any(axis=1).sum())
    return wrong + int((image != _with_cones(rest, pairs, image, even)).any(axis=1).sum())


def repaired(
    rest: np.ndarray,
    faces: np.ndarray,
    pairs: np.ndarray,
    image: np.ndarray,
    held: np.ndarray,
    even: bool,
) -> np.ndarray:
    """The image with flipped triangles turned back where possible, copies moving together.

    See :func:`nsm.domains.reinsertion.turned_back`: energy and Jacobians of triangles are the same
    in all lifts, so that patches across copies and around cones need no unfolding.

    Args:
        rest: (V, 2) the vertices in the plane, no triangle flipped.
        faces: (F, 3), each triangle in one lift.
        pairs, image, even: as for :func:`copied`.
        held: (V,) mask of vertices, such as landmarks, that move only if flips remain otherwise.

    Returns:
        (V, 2): :func:`copied`, except near flips. The caller counts flips that remain.
    """
    image = copied(rest, pairs, image, even)
    copies = _copies(rest, pairs, image, even)
    return turned_back(rest, faces, image, _cones(rest, even), held, copies)


def isotopy_class(
    rest: np.ndarray, pairs: np.ndarray, image: np.ndarray, even: bool
) -> tuple[np.ndarray, np.ndarray]:
    """B (2, 2) and c (2,), integers, of an equivariant map; c is zero on the torus, where it is not
    asked for.

    Args:
        rest, pairs, image, even: as for :func:`copied`.
    """
    if even:
        cones = _cones(rest, even)
        points = np.concatenate([rest[cones], np.ones((int(cones.sum()), 1))], axis=1)
        values = np.rint(image[cones])
    else:
        points, values = (x[pairs[:, 1]] - x[pairs[:, 0]] for x in (rest, image))
    solution = np.rint(np.linalg.lstsq(points, values, rcond=None)[0])
    solution += 0.0  # no negative zeros
    return solution[:2].T, solution[2] if even else np.zeros(2)


def _cones(rest: np.ndarray, even: bool) -> np.ndarray:
    """Mask (V,) of the vertices at fixed points of half-turns."""
    at = (rest == np.rint(rest)).all(axis=1)
    return at if even else np.zeros_like(at)


def _with_cones(rest: np.ndarray, pairs: np.ndarray, image: np.ndarray, even: bool) -> np.ndarray:
    """The image (V, 2) with cones at their lattice points."""
    image = np.array(image, dtype=np.float64)
    matrix, shift = isotopy_class(rest, pairs, image, even)
    cones = _cones(rest, even)
    image[cones] = rest[cones] @ matrix.T + shift
    return image


def _copies(rest: np.ndarray, pairs: np.ndarray, image: np.ndarray, even: bool) -> Copies:
    """How copies follow their vertices under the map."""
    pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    matrix, center = isotopy_class(rest, pairs, image, even)
    a, b = rest[pairs[:, 0]], rest[pairs[:, 1]]
    straight, turned = ((b - s * a) / SIDE for s in (1, -1))
    is_turned = even & (_off(turned) < _off(straight))[:, None]
    moves = np.rint(np.where(is_turned, turned, straight))
    copies = Copies.none(len(rest))
    copies.first[pairs[:, 1]] = pairs[:, 0]
    copies.sign[pairs[:, 1]] = np.where(is_turned[:, 0], -1.0, 1.0)
    copies.shift[pairs[:, 1]] = SIDE * moves @ matrix.T + np.where(is_turned, 2 * center, 0.0)
    reach = float(np.abs(image).max(initial=1.0) + np.abs(copies.shift).max(initial=0.0))
    step = max(_STEP, 2.0 ** (math.ceil(math.log2(reach)) - _DIGITS))
    return Copies(copies.first, copies.sign, copies.shift, step)


def _off(steps: np.ndarray) -> np.ndarray:
    """How far (T,) steps (T, 2) are from whole ones."""
    return np.abs(steps - np.rint(steps)).max(axis=1)
