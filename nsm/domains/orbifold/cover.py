"""Points of Ω = R²/Γ and their lifts: the nearest lift, and the place on the mesh."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.layout import Layout
from nsm.domains.orbifold import group
from nsm.domains.orbifold.embedding import SIDE, Embedding, reduced_basis
from nsm.domains.orbifold.repair import isotopy_class
from nsm.surfaces.location import Locator, Places

if TYPE_CHECKING:
    from torch import Tensor


def nearest_lifts(
    points: Tensor, near: Tensor, symmetric: bool, lattice: np.ndarray | None = None
) -> tuple[Tensor, Tensor]:
    """How points (N, 2) are moved to their lifts that are nearest to others (N, 2).

    Args:
        points, near: in coordinates of Ω.
        symmetric: whether x and -x are one point: the orbifold.
        lattice: (2, 2) of an embedding, by whose plane distances are measured; of Ω if not given.

    Returns:
        s (N, 1), which is ±1, and k (N, 2): the lifts are s x + k.
    """
    import torch

    shape = np.eye(2) if lattice is None else lattice / SIDE
    basis = reduced_basis(shape)  # in another the nearest lift may be far from the rounded one
    back = torch.from_numpy(np.rint(np.linalg.inv(basis)).T).to(points)
    across, in_plane = (torch.from_numpy(m.T.copy()).to(points) for m in (basis, shape))
    signs, shifts = torch.ones_like(points[:, :1]), torch.zeros_like(points)
    least = torch.full_like(points[:, :1], torch.inf)
    for sign in (1.0, -1.0) if symmetric else (1.0,):
        first = ((near - sign * points) @ back / SIDE).round()
        for shift in product((-1.0, 0.0, 1.0), repeat=2):
            by = SIDE * ((first + first.new_tensor(shift)) @ across)
            distance = ((sign * points + by - near) @ in_plane).norm(dim=1, keepdim=True)
            closer = distance < least
            signs = torch.where(closer, sign, signs)
            shifts = torch.where(closer, by, shifts)
            least = torch.where(closer, distance, least)
    return signs, shifts


def lifted_near(
    points: np.ndarray, near: np.ndarray, symmetric: bool, lattice: np.ndarray | None = None
) -> np.ndarray:
    """Of all lifts of points (N, 2) those (N, 2) that are nearest to others (N, 2); arguments as
    for :func:`nearest_lifts`."""
    import torch

    x, there = torch.as_tensor(points).double(), torch.as_tensor(near).double()
    sign, shift = nearest_lifts(x, there, symmetric, lattice)
    return (sign * x + shift).numpy()


def triangles_over_domain(
    corners: np.ndarray, symmetric: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All lifts of triangles (F, 3, 2) that meet the fundamental domain.

    Returns:
        the lifts (K, 3, 2), their faces (K,), and the elements (K, 3) of the group that move each
        face there.
    """
    _, home = group.into_domain(corners.mean(axis=1) / SIDE, symmetric)
    corners = SIDE * group.moved(home[:, None], corners / SIDE)
    low = np.array([-1.0, 0.0 if symmetric else -1.0])
    lowest, highest = (
        function(function(corners[:, 0], corners[:, 1]), corners[:, 2])
        for function in (np.minimum, np.maximum)
    )
    parts, numbers, elements = [], [], []
    for sign in (1, -1) if symmetric else (1,):
        least, most = (lowest, highest) if sign > 0 else (-highest, -lowest)
        first = np.ceil((low - most.max(axis=0)) / SIDE).astype(int)
        last = np.floor((1.0 - least.min(axis=0)) / SIDE).astype(int)
        for shift in product(*(range(a, b + 1) for a, b in zip(first, last, strict=True))):
            by = SIDE * np.array(shift)
            meets = np.logical_and(*((most + by >= low) & (least + by <= 1.0)).T)
            parts.append(sign * corners[meets] + by)
            numbers.append(np.flatnonzero(meets))
            elements.append(group.compose(np.array([sign, *shift]), home[meets]))
    return np.concatenate(parts), np.concatenate(numbers), np.concatenate(elements)


class Cover:
    """Triangles that cover Ω, on which points are looked up in any lift.

    Args:
        corners: (F, 3, 2), each triangle in one lift.
        symmetric: whether x and -x are one point: the orbifold.
    """

    def __init__(self, corners: np.ndarray, symmetric: bool) -> None:
        self.symmetric = symmetric
        lifts, self._number, self._element = triangles_over_domain(corners, symmetric)
        self._lifts = Locator(lifts.reshape(-1, 2), np.arange(3 * len(lifts)).reshape(-1, 3))

    def located(self, points: np.ndarray) -> tuple[Places, np.ndarray]:
        """Where points (N, 2) lie on the triangles, and the elements (N, 3) of the group that move
        each point's triangle to where the point is."""
        x, back = group.into_domain(points / SIDE, self.symmetric)
        found = self._lifts.locate(SIDE * x)
        there = group.compose(group.inverse(back), self._element[found.face])
        return Places(self._number[found.face], found.weights), there


class ClosedLayout(Layout):
    """A mesh laid out over Ω = R²/Γ, each triangle in one lift.

    Args:
        uv, faces: as for :class:`Layout`.
        symmetric: as for :class:`Cover`.
    """

    def __init__(self, uv: np.ndarray, faces: np.ndarray, symmetric: bool) -> None:
        self.uv, self.faces = uv, faces
        self._cover = Cover(uv[faces], symmetric)

    def locate(self, points: np.ndarray) -> Places:
        """The places of points (N, 2), in any lift."""
        return self._cover.located(points)[0]

    def carried(self, points: np.ndarray, after: np.ndarray, copies: np.ndarray) -> np.ndarray:
        """As :meth:`Layout.carried`: the map is equivariant, and images are in the lifts that it
        sends the points to."""
        symmetric = self._cover.symmetric
        places, element = self._cover.located(points)
        value = places.take(after, self.faces)
        matrix, shift = isotopy_class(self.uv, copies, after, symmetric)
        sign, moves = element[:, :1], element[:, 1:] * SIDE
        # h(γx) = γ'h(x): for γ = (x ↦ sx + k), γ' is y ↦ sy + Bk + (1 - s)c
        return sign * value + moves @ matrix.T + (1 - sign) * shift


def located(embedding: Embedding, points: np.ndarray) -> Places:
    """Where points (N, 2) of Ω, in any lift, lie on the mesh: faces and barycentric weights."""
    return Cover(embedding.corners(), embedding.cones is not None).located(points)[0]
