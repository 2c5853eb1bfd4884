"""Whether a map of a closed surface to the orbifold or the torus is a homeomorphism, exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.domains.orbifold import group
from nsm.surfaces import topology
from nsm.surfaces.predicates import orientation


@dataclass(frozen=True)
class Certificate:
    """What holds of a piecewise linear map of a closed mesh to R²/Γ.

    flipped (F,): triangles that are not counter-clockwise in the cover, by exact signs.
    torn: edges whose two triangles do not agree on where it lies. cones_held: the cones are at
    the fixed points of their half-turns. degree: how often the domain is covered, an integer if
    nothing is torn.
    """

    flipped: np.ndarray
    torn: int
    cones_held: bool
    degree: float

    @property
    def injective(self) -> bool:
        """The map is a homeomorphism onto the domain: positive triangles that cover it once."""
        return (
            not self.flipped.any()
            and self.torn == 0
            and self.cones_held
            and abs(self.degree - 1.0) < 1e-6
        )


def certificate(
    faces: np.ndarray, lift: np.ndarray, x: np.ndarray, cones: np.ndarray | None = None
) -> Certificate:
    """Check a map of a closed mesh, or of an image of it under an equivariant map.

    Args:
        faces: (F, 3).
        lift: (F, 3, 3) elements that bring a face's three corners into one piece.
        x: (V, 2) canonical coordinates of the vertices in units of the lattice; rounded to
            multiples of ``group.STEP`` here, so that the corners' positions are exact.
        cones: (4,) vertices at the cones; None for a torus.
    """
    exact = group.rounded(x)
    corner = group.moved(lift, exact[faces])
    flipped = orientation(corner[:, 0], corner[:, 1], corner[:, 2]) <= 0
    b, c = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = 0.5 * float((b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]).sum())
    held = cones is None or bool((exact[cones] == group.CONES).all())
    degree = area / (1.0 if cones is None else 0.5)
    return Certificate(flipped, torn_edges(faces, lift, cones), held, degree)


def torn_edges(faces: np.ndarray, lift: np.ndarray, cones: np.ndarray | None = None) -> int:
    """How many edges have two triangles whose lifts no element of the group joins.

    At a cone, two lifts that differ by its half-turn are the same point.
    """
    pairs = topology.adjacent_faces(topology.edges_of(faces))
    face, k = pairs // 3, pairs % 3
    following = (k + 1) % 3
    flat = lift.reshape(-1, 3)

    def joining(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return group.compose(flat[i], group.inverse(flat[j]))

    first, second = pairs.T
    next_first, next_second = (3 * face + following).T
    tail = joining(first, next_second)
    head = joining(next_first, second)
    torn = np.flatnonzero((tail != head).any(axis=1))
    if cones is None or not len(torn):
        return len(torn)
    first, next_first, second, next_second = (
        i[torn] for i in (first, next_first, second, next_second)
    )
    number = np.full(int(faces.max()) + 1, -1)
    number[cones] = np.arange(4)
    vertices = faces.ravel()
    turn = group.half_turn(group.CONES)

    def ways(i: np.ndarray, j: np.ndarray, joined: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What joins two lifts of a vertex, and what does through a cone there."""
        cone = number[vertices[i]]
        through = group.compose(group.compose(flat[i], turn[cone]), group.inverse(flat[j]))
        return joined, np.where(cone[:, None] >= 0, through, joined)

    agree = np.zeros(len(torn), dtype=bool)
    for a in ways(first, next_second, tail[torn]):
        for b in ways(next_first, second, head[torn]):
            agree |= (a == b).all(axis=1)
    return int((~agree).sum())
