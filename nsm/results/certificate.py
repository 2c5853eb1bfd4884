"""Whether a map of a mesh to the plane is injective, counted on all of it; and its repair.

A piecewise linear map of a disc-shaped mesh is injective if no triangle is flipped or flat and
the boundary's image is a polygon that does not cross itself, run through once. One of a closed
surface is a homeomorphism if it is continuous, of degree one, and no triangle is flipped or flat.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsm.domains import Domain
from nsm.domains.planar_mesh import boundary_self_intersections, flipped
from nsm.domains.reinsertion import turned_back
from nsm.surfaces.topology import boundary_loops
from nsm.wording import number_of

INTO = "injective into the target"  # of a part of a shape
# what certificates count, one of each in words
_COUNTED = {
    "flipped_triangles": "flipped triangle",
    "torn_vertices": "torn vertex",
    "boundary_self_intersections": "boundary self intersection",
    "boundary_order_violations": "boundary order violation",
}


def certificate(
    domain: Domain | None,
    uv: np.ndarray,
    faces: np.ndarray,
    *,
    rest: np.ndarray | None = None,
    copies: np.ndarray | None = None,
) -> dict[str, Any]:
    """The verdict on the piecewise linear map that sends a mesh's vertices to uv.

    Args:
        domain: Ω, which the mesh should cover; without it the boundary is free, and may not cross
            itself.
        uv: (V, 2) images of the vertices.
        faces: (F, 3), counter-clockwise before the map.
        rest, copies: on a closed domain, as for :meth:`nsm.domains.Domain.certificate`.

    Returns:
        certified; flipped_triangles; and what the domain counts beside them
        (:meth:`nsm.domains.Domain.certificate`), or boundary_self_intersections. Certified is true
        if all counts, which are made with exact signs, are zero.
    """
    if domain is not None:
        return domain.certificate(uv, faces, rest=rest, copies=copies)
    turned = int(flipped(uv, faces).sum())
    crossings = boundary_self_intersections(uv, boundary_loops(faces)[0])
    return {
        "certified": turned == 0 and crossings == 0,
        "flipped_triangles": turned,
        "boundary_self_intersections": crossings,
    }


def combined(certificates: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """One certificate for several maps: all must hold, and counts add up."""
    listed = list(certificates)
    total: dict[str, Any] = {"certified": all(c["certified"] for c in listed)}
    for name in listed[0]:
        if name != "certified":
            total[name] = sum(c[name] for c in listed)
    return total


def statement(domain: Domain | None, seam: bool = False) -> str:
    """What a certificate says of a map of surfaces over Ω, or of one to the plane (None).

    Args:
        domain: Ω.
        seam: whether the source was cut: the map is then one of the cut surface.
    """
    if domain is not None and not domain.has_boundary:
        return "a homeomorphism of the closed surfaces"
    return "injective on the cut surface" if seam else "injective"


def verdict(found: dict[str, Any], what: str = "injective") -> str:
    """A certificate in one line; ``what`` it says of the map, as :func:`statement` words it."""
    counts = [
        number_of(n, _COUNTED[name]) if name in _COUNTED else f"{n} {name.replace('_', ' ')}"
        for name, n in found.items()
        if name != "certified"
    ]
    start = f"certified {what}" if found["certified"] else f"NOT certified {what}"
    return f"{start}: {', '.join(counts)}"


def repaired(
    domain: Domain | None,
    rest: np.ndarray,
    faces: np.ndarray,
    image: np.ndarray,
    held: np.ndarray,
    copies: np.ndarray | None = None,
) -> np.ndarray:
    """The image (V, 2) of a mesh with flips turned back, where that can be done.

    Args:
        domain: Ω, whose boundary is kept; without it the boundary is free.
        rest, faces, image, held, copies: as for :meth:`nsm.domains.Domain.repaired`.
    """
    if domain is not None:
        return domain.repaired(rest, faces, image, held, copies)
    return turned_back(rest, faces, image, np.zeros_like(held), held)


@dataclass(frozen=True)
class Correction:
    """Vertices (M,) whose image is not what the network says, and what it is instead, (M, 2)."""

    vertices: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    uv: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))

    @classmethod
    def between(cls, before: np.ndarray, after: np.ndarray, present: Correction) -> Correction:
        """What takes images (V, 2) before, in which another is at work, to those after."""
        moved = (before != after).any(axis=1)
        moved[present.vertices] = True
        return cls(np.flatnonzero(moved), after[moved])

    def of(self, image: np.ndarray) -> np.ndarray:
        """The image (V, 2), corrected."""
        result = image.copy()
        result[self.vertices] = self.uv
        return result

    def tensors(self, prefix: str = "") -> dict[str, Tensor]:
        """What is saved of it: nothing, if it is empty."""
        if not len(self.vertices):
            return {}
        return {
            f"{prefix}corrected.vertices": torch.from_numpy(self.vertices),
            f"{prefix}corrected.uv": torch.from_numpy(self.uv),
        }

    @classmethod
    def taken(cls, tensors: dict[str, Tensor], count: int, prefix: str = "") -> Correction:
        """Take what :meth:`tensors` made out of those of an artefact, for a mesh of ``count``
        vertices; ValueError for anything else."""
        if f"{prefix}corrected.vertices" not in tensors:
            return cls()
        vertices = tensors.pop(f"{prefix}corrected.vertices").numpy()
        uv = tensors.pop(f"{prefix}corrected.uv").numpy()
        fits = vertices.ndim == 1 and uv.shape == (len(vertices), 2)
        if not fits or vertices.dtype != np.int64 or not np.isfinite(uv).all():
            raise ValueError("corrected vertices are not what a map saves")
        if len(vertices) and not 0 <= vertices.min() <= vertices.max() < count:
            raise ValueError("a corrected vertex is not there")
        return cls(vertices, uv.astype(np.float64))
