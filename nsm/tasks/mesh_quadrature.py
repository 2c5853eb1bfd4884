"""The triangles of a mesh as the places where a map's distortion is measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from nsm.energies import At
from nsm.energies.metrics import determinant
from nsm.tasks.triangle_quantities import centres, determinants, forms, sides

_AT_ONCE = 8192
MOST = 65_536  # triangles of a mesh that are all taken
_THIN = 1e-4  # height of a triangle in Ω


@dataclass(frozen=True, eq=False)
class Triangles:
    """Some of a mesh's triangles. What does not depend on a map is computed once.

    Attributes:
        uv: (V, 2) their corners in Ω.
        faces: (F, 3) in ``uv``.
        points: (V, 3) of the surface at the corners.
        metric: (F, 2, 2) of the surface in the frame of each triangle's first two sides.
        share: (F,) of the area that each stands for; they add up to one.
        determinant: (F,) twice the signed area in Ω.
        oriented: (F,) ``share``, or zero where a triangle is so thin in Ω that single precision
            does not tell whether its image has turned over.
    """

    uv: Tensor
    faces: Tensor
    points: Tensor
    metric: Tensor
    share: Tensor
    determinant: Tensor
    oriented: Tensor

    @cached_property
    def _own(self) -> tuple[Tensor, Tensor]:
        """(F,) whether single precision tells an orientation; the determinants where it does."""
        told = self.oriented > 0
        return told, torch.where(told, self.determinant, 1.0)

    def forms(self, image: Tensor) -> Tensor:
        """First fundamental forms (F, 2, 2), in the frames of the triangles' first two sides, of
        the map that is linear on them with images (V, n) of the corners."""
        return forms(image, self.faces)

    def relative(self, image: Tensor) -> Tensor:
        """Signed areas (F,) of the triangles with images (V, 2) of the corners, in units of their
        own; 1 where single precision does not tell."""
        told, own = self._own
        return torch.where(told, determinants(image, self.faces) / own, 1.0)

    def centres_on(self, image: Tensor) -> Tensor:
        """The centres (F, n) of the triangles with images (V, n) of the corners."""
        return centres(image, self.faces)

    @cached_property
    def centres(self) -> Tensor:
        """(F, 2) in Ω."""
        return self.centres_on(self.uv)

    @cached_property
    def positions(self) -> Tensor:
        """(F, 3): the centres on the surface."""
        return self.centres_on(self.points)

    @property
    def at(self) -> At:
        """The centres in Ω and on the surface."""
        return At(self.centres, self.positions)


class MeshQuadrature(nn.Module):
    """Triangles of a mesh, as many as are wanted, spread evenly by area.

    A map that is linear on them has the distortion that figures are measured by, and nothing that
    lies between a few samples is overlooked.

    Args:
        uv: (V, 2) vertices of the mesh in Ω.
        faces: (F, 3), counter-clockwise.
        surface: φ, (N, 2) to (N, 3).
    """

    uv: Tensor
    faces: Tensor

    def __init__(self, uv: Tensor, faces: Tensor, surface: nn.Module) -> None:
        super().__init__()
        self.register_buffer("uv", uv, persistent=False)
        self.register_buffer("faces", faces, persistent=False)
        self._surface = [surface]  # not a part of this module
        self._taken: tuple[tuple[int, int], Triangles] | None = None

    @property
    def surface(self) -> Any:
        """φ."""
        return self._surface[0]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_taken": None}

    @torch.no_grad()
    def take(self, count: int = MOST, most: int = MOST) -> Triangles:
        """All triangles; of a mesh with more than ``most``, those in the middle of ``count`` parts
        of equal area, if these are fewer."""
        if self._taken is not None and self._taken[0] == (count, most):
            return self._taken[1]
        points = torch.cat([self.surface(part) for part in self.uv.split(_AT_ONCE)])
        whole = triangles(self.uv, self.faces, points)
        if count < len(self.faces) > most:
            ends = whole.share.double().cumsum(0)
            middles = (torch.arange(count, device=ends.device).double() + 0.5) / count * ends[-1]
            found, times = torch.searchsorted(ends, middles).unique_consecutive(return_counts=True)
            found = found.clamp(max=len(self.faces) - 1)
            rows, faces = self.faces[found].unique(return_inverse=True)
            part = triangles(self.uv[rows], faces, points[rows])
            share = times.to(part.share) / count
            oriented = share * (part.oriented > 0)
            whole = replace(part, share=share, oriented=oriented)
        self._taken = (count, most), whole
        return whole


def triangles(uv: Tensor, faces: Tensor, points: Tensor) -> Triangles:
    """Those with corners uv (V, 2) in Ω and points (V, 3) of the surface, faces (F, 3)."""
    metric = forms(points, faces)
    area = determinant(metric.double()).clamp(min=0).sqrt()
    share = (area / area.sum()).to(metric.dtype)
    two = sides(uv, faces)
    longest = torch.cat([two, two[..., :1] - two[..., 1:]], dim=-1).norm(dim=1).amax(dim=1)
    signed = determinants(uv, faces)
    oriented = torch.where(signed > _THIN * longest, share, 0.0)
    return Triangles(uv, faces, points, metric, share, signed, oriented)
