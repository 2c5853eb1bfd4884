"""What a planar domain Ω is asked for: layout, location, maps that keep it, certificate, repair.

:class:`Domain` assumes no boundary: Ω may be a quotient of the plane. :class:`BoundedDomain` adds
what only a domain with one boundary loop has. Meshes are numpy arrays, what networks see tensors;
torch is imported only where a tensor is made.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from nsm.domains import embedding, planar_mesh, untangling
from nsm.domains.layout import Layout
from nsm.domains.reinsertion import turned_back
from nsm.surfaces.location import Places
from nsm.surfaces.topology import boundary_loops

if TYPE_CHECKING:
    from torch import Tensor, nn

    from nsm.domains.embedding import Embedding


@dataclass(frozen=True)
class Keys:
    """Boundary vertices (K,) that are held at fractions (K,) in [0, 1) of the way around ∂Ω.

    Both run counter-clockwise, as the boundary loop does (see
    :meth:`BoundedDomain.boundary_points`).
    """

    vertices: np.ndarray
    fractions: np.ndarray


class Domain(ABC):
    """A domain Ω in the plane over which surfaces are laid out.

    Subclasses are frozen dataclasses: domains with equal parameters are equal. A map h of Ω is
    ``equivariant(network)``; a surface φ over Ω is ``symmetric(network)``.
    """

    name: ClassVar[str]  # what files and messages call it
    area: ClassVar[float]  # to which surfaces are scaled
    has_boundary: ClassVar[bool]
    network_out_dim: ClassVar[int] = 2  # of the network that ``equivariant`` takes

    def __str__(self) -> str:
        return self.name

    @property
    def config(self) -> dict[str, Any]:
        """Settings with ``_target_`` from which the domain is made again."""
        kind = type(self)
        fields = asdict(self)  # type: ignore[call-overload]  # subclasses are dataclasses
        return {"_target_": f"{kind.__module__}.{kind.__qualname__}", **fields}

    @abstractmethod
    def embed(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        method: str = "slim",
        name: str = "mesh",
        keys: Any = None,
    ) -> Any:
        """Lay a mesh (V, 3), (F, 3) of Ω's topology and area out over Ω, injectively.

        Args:
            method: one of :data:`nsm.domains.embedding.METHODS`.
            name: of the mesh, in messages.
            keys: vertices held in places of the domain's choice (:class:`Keys` on a boundary).

        Raises:
            NsmError: ``unknown_option``, or ``not_injective`` if triangles flip.
        """

    @abstractmethod
    def certificate(
        self,
        image: np.ndarray,
        faces: np.ndarray,
        *,
        rest: np.ndarray | None = None,
        copies: np.ndarray | None = None,
    ) -> dict[str, Any]:
        """The verdict on the piecewise linear map that sends a mesh's vertices to points of Ω.

        Args:
            image: (V, 2) where the vertices are sent.
            faces: (F, 3).
            rest, copies: on a closed domain, the vertices (V, 2) before the map, and pairs (T, 2)
                of those that are one point of the surface.

        Returns:
            ``certified``, true if all counts are zero, and these counts, by exact signs;
            ``flipped_triangles`` is one of them.
        """

    @abstractmethod
    def repaired(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        image: np.ndarray,
        held: np.ndarray,
        copies: np.ndarray | None = None,
    ) -> np.ndarray:
        """The image (V, 2) of a mesh over Ω, with flipped triangles turned back where possible.

        Args:
            rest: (V, 2) the mesh before it is mapped, without flips.
            faces: (F, 3).
            image: (V, 2) where the map sends its vertices.
            held: (V,) mask of vertices, such as landmarks, that move only if flips remain
                otherwise.
            copies: as for :meth:`certificate`.
        """

    def copied(self, rest: np.ndarray, copies: np.ndarray, image: np.ndarray) -> np.ndarray:
        """The image (V, 2), made the same to the last digit for copies of one point of a closed
        domain; arguments as for :meth:`repaired`."""
        return image

    @abstractmethod
    def contains(self, points: np.ndarray) -> np.ndarray:
        """Mask (...) of the points (..., 2) that a picture of Ω shows."""

    def layout(self, uv: np.ndarray, faces: np.ndarray) -> Layout:
        """A mesh laid out over Ω, uv (V, 2), faces (F, 3), on which points are looked up."""
        return Layout(uv, faces)

    def locate(self, points: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> Places:
        """The places of points (N, 2) of Ω on such a mesh; for one call only."""
        return self.layout(uv, faces).locate(points)

    def canonical(self, points: np.ndarray) -> np.ndarray:
        """Of the lifts of points (N, 2), those (N, 2) in the fundamental domain of a closed Ω."""
        return points

    def lift(self, points: Tensor, near: Tensor, lattice: np.ndarray | None = None) -> Tensor:
        """The representatives of points (N, 2) of Ω nearest to others (N, 2) in the plane.

        Args:
            lattice: (2, 2) of a surface on a closed domain, in whose plane distances are measured.
        """
        return points

    @abstractmethod
    def nearest_rotation(self, rotation: Tensor) -> Tensor:
        """The rotation (2, 2) nearest to a given one among those that take Ω to itself."""

    @abstractmethod
    def rotations(self) -> np.ndarray:
        """Rotations (K, 2, 2) that take Ω to itself, evenly spread, the identity first."""

    @abstractmethod
    def mesh(self, rings: int = ...) -> tuple[np.ndarray, np.ndarray]:
        """An even triangulation of Ω: points (V, 2) and faces (F, 3).

        Args:
            rings: edges between the centre and ∂Ω, about; by default enough for pictures.
        """

    @abstractmethod
    def equivariant(self, network: nn.Module) -> nn.Module:
        """A map h of Ω to itself around a network with ``network_out_dim`` outputs.

        h is the identity where the network is zero, and keeps Ω's boundary or symmetries by
        construction.
        """

    def encoding(
        self,
        settings: Mapping[str, Any],
        lattice: np.ndarray | None = None,
        *,
        of_map: bool = False,
    ) -> dict[str, Any]:
        """The settings of an encoding with Ω's symmetries, from those that a user gives.

        Args:
            settings: with ``_target_``.
            lattice: (2, 2) of the surface, on a closed domain.
            of_map: for the network of :meth:`equivariant`, not for a surface's.
        """
        return dict(settings)

    def symmetric(self, network: nn.Module) -> nn.Module:
        """A surface φ over Ω around a network, with Ω's symmetries by construction."""
        return network


class BoundedDomain(Domain):
    """A convex domain around the origin with one boundary loop ∂Ω.

    Fractions count the way around ∂Ω counter-clockwise, in [0, 1).
    """

    has_boundary = True
    corner_fractions: ClassVar[tuple[float, ...]] = ()  # the first at 0

    @abstractmethod
    def boundary_points(self, fractions: np.ndarray) -> np.ndarray:
        """Points (B, 2) of ∂Ω at fractions (B,) of the way around it."""

    @abstractmethod
    def boundary_fractions(self, points: np.ndarray) -> np.ndarray:
        """Fractions (B,) of points (B, 2) of ∂Ω: the inverse of :meth:`boundary_points`."""

    @abstractmethod
    def spread(self, along: np.ndarray, name: str = "mesh") -> np.ndarray:
        """Points (B, 2) of ∂Ω for the vertices of a closed polygon, by arc length.

        Args:
            along: (B + 1,) lengths from the first vertex to each, the last the whole.
            name: of the mesh, in messages.

        Raises:
            NsmError: ``wrong_domain``: fewer vertices than corners.
        """

    @abstractmethod
    def tangents(self, points: np.ndarray) -> np.ndarray:
        """Unit directions (B, 2) in which points (B, 2) of ∂Ω may slide."""

    @abstractmethod
    def curvature(self, points: np.ndarray) -> np.ndarray:
        """Curvature vectors (B, 2) of ∂Ω at points (B, 2)."""

    @abstractmethod
    def retract(self, points: np.ndarray) -> np.ndarray:
        """Points (B, 2) of tangents or chords of ∂Ω, brought back to ∂Ω within its sides."""

    @abstractmethod
    def signed_distance(self, points: Tensor) -> Tensor:
        """Euclidean distances (...) of points (..., 2) to ∂Ω, negative inside."""

    @abstractmethod
    def project(self, points: Tensor) -> Tensor:
        """The points (..., 2) of Ω nearest to given ones (..., 2)."""

    @abstractmethod
    def to_boundary(self, points: Tensor) -> Tensor:
        """Points (..., 2), none at the origin, scaled onto ∂Ω."""

    @property
    def corners(self) -> np.ndarray:
        """(K, 2), in the order in which ∂Ω is walked."""
        return self.boundary_points(np.array(self.corner_fractions))

    def boundary_samples(self, count: int = 512) -> Tensor:
        """Points (count, 2) of ∂Ω, evenly spaced, float32."""
        import torch

        return torch.from_numpy(self.boundary_points(np.arange(count) / count)).float()

    def at_corner(self, points: np.ndarray) -> np.ndarray:
        """Mask (B,) of points (B, 2) that are corners."""
        return (points[:, None] == self.corners).all(axis=2).any(axis=1)

    def slide(self, points: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Points (B, 2) of ∂Ω moved along it by lengths (B,), signed as the tangents are."""
        return self.retract(points + lengths[:, None] * self.tangents(points))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Mask (...) of the points (..., 2) of Ω, boundary included."""
        import torch

        return self.signed_distance(torch.from_numpy(points)).numpy() <= 0

    def near_corners(self, along: np.ndarray, length: float) -> list[int]:
        """For each corner, which of the rising places along (B,) ∂Ω is to become it.

        The first place is the first corner's. The others take the nearest, each one of its own.
        """
        count = len(self.corner_fractions)
        chosen = [0]
        for k, fraction in enumerate(self.corner_fractions[1:], start=1):
            nearest = int(np.abs(along - fraction * length).argmin())
            chosen.append(min(max(nearest, chosen[-1] + 1), len(along) - count + k))
        return chosen

    def through_corners(self, fractions: np.ndarray) -> np.ndarray:
        """Rising fractions (K,), the first 0, warped so that those near corners become corners."""
        if not self.corner_fractions or len(fractions) < len(self.corner_fractions):
            return fractions
        corners = self.near_corners(fractions, 1.0)
        return np.interp(fractions, [*fractions[corners], 1.0], [*self.corner_fractions, 1.0])

    def place_boundary(
        self,
        vertices: np.ndarray,
        loop: np.ndarray,
        name: str = "mesh",
        keys: Keys | None = None,
    ) -> np.ndarray:
        """Points (B, 2) of ∂Ω for a mesh's boundary loop (B,), by arc length.

        With keys, arc length counts between neighbouring keys.

        Raises:
            NsmError: as :meth:`spread`.
        """
        if keys is not None:
            return self.boundary_points(self._fractions_between(vertices, loop, keys))
        lengths = np.linalg.norm(vertices[np.roll(loop, -1)] - vertices[loop], axis=1)
        return self.spread(np.concatenate([[0.0], np.cumsum(lengths)]), name)

    def _fractions_between(self, vertices: np.ndarray, loop: np.ndarray, keys: Keys) -> np.ndarray:
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
        free = np.setdiff1d(np.arange(len(loop)), stops)
        for corner in self.corner_fractions:
            if np.isclose(result[stops], corner, atol=1e-12).any():
                continue
            # a corner without a key takes the nearest vertex that is none
            gap = np.abs((result[free] - corner + 0.5) % 1.0 - 0.5)
            result[free[gap.argmin()]] = corner
        return result

    def embed(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        method: str = "slim",
        name: str = "mesh",
        keys: Keys | None = None,
    ) -> Embedding:
        """See :func:`nsm.domains.embedding.embed`."""
        return embedding.embed(self, vertices, faces, method=method, name=name, keys=keys)

    def certificate(
        self,
        image: np.ndarray,
        faces: np.ndarray,
        *,
        rest: np.ndarray | None = None,
        copies: np.ndarray | None = None,
    ) -> dict[str, Any]:
        """As :meth:`Domain.certificate`: the boundary should go around ∂Ω once, in order.

        ``boundary_order_violations`` counts sides that do not run counter-clockwise around the
        middle of Ω.
        """
        flipped = int(planar_mesh.flipped(image, faces).sum())
        wrong = planar_mesh.order_violations(image[boundary_loops(faces)[0]])
        return {
            "certified": flipped == 0 and wrong == 0,
            "flipped_triangles": flipped,
            "boundary_order_violations": wrong,
        }

    def repaired(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        image: np.ndarray,
        held: np.ndarray,
        copies: np.ndarray | None = None,
    ) -> np.ndarray:
        """As :meth:`Domain.repaired`; the boundary's vertices move along ∂Ω only, and only if they
        are out of order."""
        loop = boundary_loops(faces)[0]
        fixed = np.zeros(len(image), dtype=bool)
        fixed[loop] = True
        image = image.copy()
        if planar_mesh.order_violations(image[loop]):
            image[loop] = self.in_order(image[loop], rest[loop])
        return turned_back(rest, faces, image, fixed, held)

    def in_order(self, points: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Points (B, 2) of ∂Ω, moved along it into the order of a loop where they are not.

        Args:
            points: where a map sends the loop's vertices, which should go around Ω once.
            rest: (B, 2) where they are before, in order.

        Returns:
            (B, 2); equal to ``points`` where these do not go around once, which no small change
            repairs.
        """
        before, now = self.boundary_fractions(rest), self.boundary_fractions(points)
        moved, shift = untangling.order_shifts(now, before)
        result = points.copy()
        result[moved] = self.boundary_points(np.mod(now[moved] + shift, 1.0))
        return result


def rotations(count: int) -> np.ndarray:
    """``count`` rotations (count, 2, 2) in even steps, from the identity."""
    return np.stack([rotation_matrix(2 * np.pi * k / count) for k in range(count)])


def rotation_matrix(angle: float) -> np.ndarray:
    """The rotation (2, 2) by an angle in radians, counter-clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])
