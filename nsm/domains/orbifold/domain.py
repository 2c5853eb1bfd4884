"""Closed domains Ω = R²/Γ: the flat orbifold 2222 for genus 0, the flat torus for genus 1.

The lattice is 2Z × 2Z in coordinates of Ω, whatever the surface. The surface's own lattice (2, 2)
belongs to its layout: lengths and areas are measured in the plane of (lattice / 2) x. There, Ω has
the area π, as the disc has, so that a surface has one size on both, and losses, learning rates and
weights suit both.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from nsm.domains import planar_mesh
from nsm.domains.base import Domain
from nsm.domains.orbifold import group
from nsm.domains.orbifold.cover import ClosedLayout, nearest_lifts
from nsm.domains.orbifold.embedding import SIDE, Embedding, embed_orbifold, embed_torus
from nsm.domains.orbifold.quotient_mesh import quotient_mesh
from nsm.domains.orbifold.repair import copied, repaired, torn
from nsm.errors import NsmError
from nsm.surfaces import topology

if TYPE_CHECKING:
    from torch import Tensor, nn

_GRIDS = ("nsm.maps.encodings.SplineGrid", "nsm.maps.SplineGrid")
# cells of a surface over those on the disc, whose cut reaches all tips: a limb without a cone is
# squeezed more
_MORE = 1.25


class ClosedDomain(Domain):
    """R²/Γ, with the lattice 2Z × 2Z among Γ, and x ↦ -x too if ``even``."""

    area = math.pi  # in the plane of a surface's lattice
    has_boundary = False
    even: ClassVar[bool]
    low: ClassVar[tuple[float, float]]  # corner of the fundamental domain; the other is (1, 1)

    def embed(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        *,
        method: str = "slim",
        name: str = "mesh",
        keys: Any = None,
    ) -> Embedding:
        """Lay a closed mesh (V, 3), (F, 3) out over Ω.

        Args:
            method: ``slim``: least symmetric Dirichlet energy.
            name: of the mesh, in messages.
            keys: four vertices at the cones of an orbifold; chosen if not given.

        Raises:
            NsmError: ``wrong_topology``: the surface has a boundary or another genus;
                ``unknown_option``, ``wrong_cones`` or ``not_injective``.
        """
        self._check(faces, method, name)
        return self._embedded(vertices, faces, name, keys)

    @abstractmethod
    def _embedded(
        self, vertices: np.ndarray, faces: np.ndarray, name: str, cones: Any
    ) -> Embedding:
        """As :meth:`embed`, of a mesh of the domain's topology."""

    def _check(self, faces: np.ndarray, method: str, name: str) -> None:
        if method != "slim":
            raise NsmError(
                f"{name}: domain={self} has no parameterization {method!r}; take slim",
                kind="unknown_option",
                key="parameterization",
            )
        what, other = "has a boundary", "disc"
        if bool((topology.edges_of(faces).count == 2).all()):
            genus = 1 - topology.euler_characteristic(faces) // 2
            if genus == (0 if self.even else 1):
                return
            what = f"is closed and of genus {genus}"
            other = {0: "orbifold", 1: "torus"}.get(genus, "disc")
        raise NsmError(
            f"{name}: it {what}, which domain={self} cannot take; take domain={other}",
            kind="wrong_topology",
            key="domain",
        )

    def certificate(
        self,
        image: np.ndarray,
        faces: np.ndarray,
        *,
        rest: np.ndarray | None = None,
        copies: np.ndarray | None = None,
    ) -> dict[str, Any]:
        """As :meth:`Domain.certificate`; each triangle in one lift, as those of a surface are.

        ``torn_vertices`` are copies of a vertex that do not have one image; ``degree_error`` says
        how many times too often or too rarely Ω is covered. If all is zero, the map is a
        homeomorphism of Ω.
        """
        flipped = int(planar_mesh.flipped(image, faces).sum())
        whole = SIDE**2 / (2 if self.even else 1)  # Ω's area in its own coordinates
        degree = float(planar_mesh.signed_areas(image, faces).sum() / whole)
        wrong = abs(round(degree) - 1) if abs(degree - round(degree)) < 1e-6 else 1
        counts = {"flipped_triangles": flipped, "torn_vertices": 0, "degree_error": wrong}
        if rest is not None and copies is not None:
            counts["torn_vertices"] = torn(rest, copies, image, self.even)
        return {"certified": not any(counts.values()), **counts}

    def repaired(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        image: np.ndarray,
        held: np.ndarray,
        copies: np.ndarray | None = None,
    ) -> np.ndarray:
        """As :meth:`Domain.repaired`: in the cover, all copies of a vertex together."""
        pairs = np.zeros((0, 2), dtype=np.int64) if copies is None else copies
        return repaired(rest, faces, pairs, image, held, self.even)

    def copied(self, rest: np.ndarray, copies: np.ndarray, image: np.ndarray) -> np.ndarray:
        """As :meth:`Domain.copied`."""
        return copied(rest, copies, image, self.even)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Mask (...) of the points (..., 2) of the fundamental domain."""
        return np.asarray(((points >= self.low) & (points <= 1.0)).all(axis=-1))

    def layout(self, uv: np.ndarray, faces: np.ndarray) -> ClosedLayout:
        """As :meth:`Domain.layout`; each triangle in one lift, points in any."""
        return ClosedLayout(uv, faces, self.even)

    def canonical(self, points: np.ndarray) -> np.ndarray:
        """As :meth:`Domain.canonical`."""
        return SIDE * group.into_domain(points / SIDE, self.even)[0]

    def lift(self, points: Tensor, near: Tensor, lattice: np.ndarray | None = None) -> Tensor:
        """The lifts of points (N, 2) nearest to others (N, 2), in the plane of a surface's lattice
        (2, 2); in coordinates of Ω if it is not given."""
        here, there = points.detach(), near.detach().to(points)
        sign, shift = nearest_lifts(here, there, self.even, lattice)
        return sign * points + shift

    def nearest_rotation(self, rotation: Tensor) -> Tensor:
        """The identity (2, 2): a lattice of general shape has no other rotation."""
        import torch

        return torch.eye(2, dtype=rotation.dtype, device=rotation.device)

    def rotations(self) -> np.ndarray:
        return np.eye(2)[None]

    def mesh(self, rings: int = 60) -> tuple[np.ndarray, np.ndarray]:
        """A grid of points (V, 2) of the fundamental domain, and triangles (F, 3)."""
        return self.closed_mesh(rings)[:2]

    def closed_mesh(
        self, rings: int = 60, lattice: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As :meth:`mesh`, and the vertex (V,) that each point is a copy of.

        Args:
            rings: there are about (2 rings)² cells.
            lattice: (2, 2), in whose plane cells are nearly square; square by default.
        """
        across, along = (1.0, 1.0) if lattice is None else np.linalg.norm(lattice, axis=0)
        halves = 2 if self.even else 1
        columns = 2 * rings * math.sqrt(halves * across / along)
        rows = 2 * rings * math.sqrt(along / across / halves)
        return quotient_mesh(columns, rows, self.even)

    def encoding(
        self,
        settings: Mapping[str, Any],
        lattice: np.ndarray | None = None,
        *,
        of_map: bool = False,
    ) -> dict[str, Any]:
        """Settings of the spline grid with Ω's symmetries that stands for one on the plane.

        For a map it has r² cells on Ω, as many as a grid of the same ``resolutions``, for a surface
        a quarter more; cells are nearly square in the plane of the surface's lattice.

        Args:
            settings: of :class:`nsm.maps.SplineGrid`, or of such a grid already.
            lattice: (2, 2) of the surface; square by default.
            of_map: for the network of :meth:`equivariant`: periodic, but not even.

        Raises:
            NsmError: ``wrong_domain`` for any other encoding.
        """
        target = str(settings.get("_target_"))
        if target.endswith(".LatticeSplineGrid"):
            return {**settings, "even": self.even and not of_map}
        if target not in _GRIDS or settings.get("degree", 2) != 2:
            raise NsmError(
                f"setting encoding: domain={self} needs encoding=spline_grid of degree 2, which it "
                "makes periodic; for another encoding or degree take domain=disc",
                kind="wrong_domain",
                key="encoding",
            )
        copies = 2 if self.even else 1
        long, short = (1.0, 1.0) if lattice is None else np.linalg.norm(lattice, axis=0)
        aspect = float(np.sqrt(long / short))
        levels = []
        for resolution in settings.get("resolutions", (8, 16, 32, 64, 128)):
            side = resolution * math.sqrt(copies if of_map else _MORE * copies)
            # a power of two in each number of cells, for multigrid
            step = max(4, 2 ** int(math.log2(max(resolution, 16) / 16)))
            levels.append([max(1, round(side * f / step)) * step for f in (aspect, 1 / aspect)])
        grid = {"_target_": "nsm.maps.lattice_grid.LatticeSplineGrid", "resolutions": levels}
        even = self.even and not of_map
        return {**grid, "features": settings.get("features", 4), "even": even}

    def symmetric(self, network: nn.Module) -> nn.Module:
        """A surface φ over Ω: the network itself, whose encoding has the symmetries.

        Raises:
            NsmError: ``unsuitable_network`` if it does not (see :meth:`encoding`).
        """
        from nsm.maps import LatticeSplineGrid

        grid = getattr(network, "encoding", None)
        if not isinstance(grid, LatticeSplineGrid) or grid.even < self.even:
            raise NsmError(
                f"domain={self} needs a network whose encoding has its symmetries; take "
                "encoding=spline_grid",
                kind="unsuitable_network",
                key="encoding",
            )
        return network


@dataclass(frozen=True)
class Orbifold(ClosedDomain):
    """The flat orbifold 2222, for closed surfaces of genus 0.

    Γ is generated by the translations by 2e₁ and 2e₂ and by x ↦ -x. The fundamental domain is
    [-1, 1] × [0, 1]; four cones of angle π lie at (0, 0), (1, 0), (1, 1) and (0, 1).
    """

    name = "orbifold"
    even = True
    low = (-1.0, 0.0)

    def _embedded(
        self, vertices: np.ndarray, faces: np.ndarray, name: str, cones: Any
    ) -> Embedding:
        return embed_orbifold(vertices, faces, cones)

    def equivariant(self, network: nn.Module) -> nn.Module:
        """h(x) = x + ½(n(x) - n(-x)) around a periodic network n; x + n(x) if n is odd."""
        from nsm.maps import EquivariantMap, TorusMap

        return TorusMap(network) if getattr(network, "odd", False) else EquivariantMap(network)


@dataclass(frozen=True)
class Torus(ClosedDomain):
    """The flat torus, for closed surfaces of genus 1: Γ is the translations by 2e₁ and 2e₂.

    The fundamental domain is [-1, 1]².
    """

    name = "torus"
    even = False
    low = (-1.0, -1.0)

    def _embedded(
        self, vertices: np.ndarray, faces: np.ndarray, name: str, cones: Any
    ) -> Embedding:
        if cones is not None:
            raise NsmError(
                f"{name}: a torus has no cones; leave cones out", kind="wrong_domain", key="cones"
            )
        return embed_torus(vertices, faces)

    def equivariant(self, network: nn.Module) -> nn.Module:
        """h(x) = x + n(x) around a periodic network n."""
        from nsm.maps import TorusMap

        return TorusMap(network)
