"""The unit disc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nsm.domains.base import BoundedDomain, rotations
from nsm.surfaces.shapes import ring_mesh

if TYPE_CHECKING:
    from torch import Tensor, nn

_ROTATIONS = 48  # tried at the start of a map without landmarks


@dataclass(frozen=True)
class Disc(BoundedDomain):
    """The unit disc ‖x‖ ≤ 1; a fraction t of the way around it is the angle 2πt."""

    name = "disc"
    area = float(np.pi)
    network_out_dim = 3

    def boundary_points(self, fractions: np.ndarray) -> np.ndarray:
        return _on_circle(2 * np.pi * np.asarray(fractions, dtype=np.float64))

    def boundary_fractions(self, points: np.ndarray) -> np.ndarray:
        return (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)) % 1.0

    def spread(self, along: np.ndarray, name: str = "mesh") -> np.ndarray:
        return _on_circle(2 * np.pi * along[:-1] / along[-1])

    def tangents(self, points: np.ndarray) -> np.ndarray:
        return np.stack([-points[:, 1], points[:, 0]], axis=1)

    def curvature(self, points: np.ndarray) -> np.ndarray:
        return -points

    def slide(self, points: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        return _on_circle(np.arctan2(points[:, 1], points[:, 0]) + lengths)

    def retract(self, points: np.ndarray) -> np.ndarray:
        return points / np.linalg.norm(points, axis=1, keepdims=True)

    def signed_distance(self, points: Tensor) -> Tensor:
        return points.norm(dim=-1) - 1  # unlike a root of squares, has a gradient at the centre

    def project(self, points: Tensor) -> Tensor:
        return points / points.norm(dim=-1, keepdim=True).clamp(min=1)

    def to_boundary(self, points: Tensor) -> Tensor:
        return points / points.norm(dim=-1, keepdim=True)

    def nearest_rotation(self, rotation: Tensor) -> Tensor:
        """The rotation (2, 2) itself: all of them keep the disc."""
        return rotation

    def rotations(self) -> np.ndarray:
        return rotations(_ROTATIONS)

    def mesh(self, rings: int = 80) -> tuple[np.ndarray, np.ndarray]:
        """Points (V, 2) on rings around the centre, and triangles (F, 3)."""
        return ring_mesh(rings)

    def equivariant(self, network: nn.Module) -> nn.Module:
        """h(x) = R(θ)(x + (1 − ‖x‖²) N(x)) (see :class:`nsm.maps.DiscMap`)."""
        from nsm.maps import DiscMap

        return DiscMap(network)


def _on_circle(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
