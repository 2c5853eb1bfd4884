"""Whether a map of a mesh to the plane is injective, counted on all of it; and its repair.

A piecewise linear map of a disc-shaped mesh is injective if no triangle is flipped or flat and
the boundary's image is a polygon that does not cross itself, run through once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsm.surfaces import Surface
from nsm.surfaces.flat import boundary_self_intersections
from nsm.surfaces.topology import boundary_loops
from nsm.surfaces.untangle import flipped, in_order, order_violations, untangled


def certificate(uv: np.ndarray, faces: np.ndarray, *, onto: bool) -> dict[str, Any]:
    """The verdict on the piecewise linear map that sends a disc-shaped mesh's vertices to uv.

    Args:
        uv: (V, 2) images of the vertices.
        faces: (F, 3), counter-clockwise before the map.
        onto: the boundary should go to ∂Ω, in order; else it is free, and may not cross itself.

    Returns:
        certified; flipped_triangles; and boundary_order_violations (sides that do not run
        counter-clockwise around the middle of Ω) or boundary_self_intersections. Certified is
        true if both counts, which are made with exact signs, are zero.
    """
    loop = boundary_loops(faces)[0]
    turned = int(flipped(uv, faces).sum())
    if onto:
        name, wrong = "boundary_order_violations", order_violations(uv[loop])
    else:
        name, wrong = "boundary_self_intersections", boundary_self_intersections(uv, loop)
    return {"certified": turned == 0 and wrong == 0, "flipped_triangles": turned, name: wrong}


def combined(certificates: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """One certificate for several maps: all must hold, and counts add up."""
    listed = list(certificates)
    total: dict[str, Any] = {"certified": all(c["certified"] for c in listed)}
    for name in listed[0]:
        if name != "certified":
            total[name] = sum(c[name] for c in listed)
    return total


def verdict(found: dict[str, Any]) -> str:
    """A certificate in one line."""
    counts = [f"{n} {name.replace('_', ' ')}" for name, n in found.items() if name != "certified"]
    start = "certified injective" if found["certified"] else "NOT certified injective"
    return f"{start}: {', '.join(counts)}"


def repaired(surface: Surface, image: np.ndarray, *, held: np.ndarray, onto: bool) -> np.ndarray:
    """The image of a surface's vertices with flips turned back, where that can be done.

    Args:
        surface: whose mesh is mapped.
        image: (V, 2) where its vertices go.
        held: (V,) mask of vertices, such as landmarks, that should not move; they are let go where
            flips remain otherwise.
        onto: as in :func:`certificate`; the boundary's vertices then move along ∂Ω only, and only
            if they are out of order.
    """
    better, fixed = image.copy(), np.zeros(len(image), dtype=bool)
    if onto:
        loop = boundary_loops(surface.faces)[0]
        fixed[loop] = True
        if order_violations(better[loop]):
            better[loop] = in_order(better[loop], surface.uv[loop], surface.domain)
    for stay in (fixed | held, fixed):
        better = untangled(surface.uv, surface.faces, better, stay)
    return better


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
