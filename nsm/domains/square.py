"""The square [-1, 1]²."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.base import BoundedDomain, rotation_matrix, rotations
from nsm.errors import NsmError
from nsm.surfaces.shapes import grid_mesh

if TYPE_CHECKING:
    from torch import Tensor, nn

_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@dataclass(frozen=True)
class Square(BoundedDomain):
    """The square [-1, 1]²; its corners are at the quarters of the way around, from (-1, -1)."""

    name = "square"
    area = 4.0
    corner_fractions = (0.0, 0.25, 0.5, 0.75)

    def boundary_points(self, fractions: np.ndarray) -> np.ndarray:
        t = np.asarray(fractions, dtype=np.float64)
        side = np.floor(4 * t).astype(int) % 4
        share = (4 * t - np.floor(4 * t))[:, None]
        return _CORNERS[side] + share * (_CORNERS[(side + 1) % 4] - _CORNERS[side])

    def boundary_fractions(self, points: np.ndarray) -> np.ndarray:
        u, v = points.T
        sides = np.stack([-v, u, v, -u])  # each side is where one of these is 1
        along = np.stack([u, v, -u, -v])
        side = sides.argmax(axis=0)
        share = 0.5 * (along[side, np.arange(len(points))] + 1)
        return (0.25 * (side + share)) % 1.0

    def spread(self, along: np.ndarray, name: str = "mesh") -> np.ndarray:
        """See :meth:`BoundedDomain.spread`: vertices near the quarters become the corners."""
        count = len(along) - 1
        if count < 4:
            raise NsmError(
                f"{name}: the square domain needs four boundary vertices, not {count}; "
                "use domain=disc",
                kind="wrong_domain",
                key="domain",
            )
        corners = self.near_corners(along[:-1], float(along[-1]))
        result = np.empty((count, 2))
        for side, first in enumerate(corners):
            last = corners[side + 1] if side < 3 else count
            share = (along[first:last] - along[first]) / (along[last] - along[first])
            begin, end = _CORNERS[side], _CORNERS[(side + 1) % 4]
            result[first:last] = begin + share[:, None] * (end - begin)
        return result

    def tangents(self, points: np.ndarray) -> np.ndarray:
        """Unit directions (B, 2) of the points' sides, to the right or upwards."""
        vertical = np.abs(points[:, 0]) > np.abs(points[:, 1])
        return np.stack([~vertical, vertical], axis=1).astype(np.float64)

    def curvature(self, points: np.ndarray) -> np.ndarray:
        return np.zeros_like(points)

    def retract(self, points: np.ndarray) -> np.ndarray:
        return points.clip(-1.0, 1.0)

    def signed_distance(self, points: Tensor) -> Tensor:
        q = points.abs() - 1
        return q.clamp(min=0).norm(dim=-1) + q.amax(dim=-1).clamp(max=0)

    def project(self, points: Tensor) -> Tensor:
        return points.clamp(-1, 1)

    def to_boundary(self, points: Tensor) -> Tensor:
        return points / points.norm(math.inf, dim=-1, keepdim=True)

    def nearest_rotation(self, rotation: Tensor) -> Tensor:
        """The multiple of 90° nearest to a rotation (2, 2): others do not keep the square."""
        turns = round(math.atan2(rotation[1, 0], rotation[0, 0]) / (math.pi / 2))
        return rotation.new_tensor(rotation_matrix(turns * math.pi / 2))

    def rotations(self) -> np.ndarray:
        return rotations(4)

    def mesh(self, rings: int = 60) -> tuple[np.ndarray, np.ndarray]:
        """A grid of 2·rings × 2·rings points (V, 2), and triangles (F, 3)."""
        return grid_mesh(2 * rings)

    def equivariant(self, network: nn.Module) -> nn.Module:
        """h_i(x) = x_i + (1 − x_i²) N_i(x) (see :class:`nsm.maps.SquareMap`)."""
        from nsm.maps import SquareMap

        return SquareMap(network)
