"""The triangles of all surfaces of a collection, as one of its maps meets them."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from nsm.energies import At
from nsm.maps.inverse import Inverse
from nsm.tasks.mesh_quadrature import MOST, MeshQuadrature, Triangles, triangles

_FOUND = 1e-6  # in Ω
_SAME = 1e-5  # on a surface


class Turn(NamedTuple):
    """Where a collection is measured while one map h_i moves and the others are held.

    The triangles are those of the meshes, each taken back to the common domain by its own
    surface's map, as it was when the turn began. One of surface j counts for the maps from j, as it
    does in figures; with h_i alone, these are the map to i or, for j = i, those to all others.

    Attributes:
        number: i.
        some: F triangles in the common domain; their metric is that of their surface, their share
            that of its area divided by the number of surfaces.
        of: (M,) the triangle of each map of a triangle that h_i has a part in: first of the maps
            to surface i, then of those from it.
        inward: how many of them lead to surface i.
        held: (M, 2, 2) metric of its other end.
        at: its beginning.
        share: (M,) of the surface's area.
    """

    number: int
    some: Triangles
    of: Tensor
    inward: int
    held: Tensor
    at: At
    share: Tensor

    def ends(self, metric: Tensor) -> tuple[Tensor, Tensor]:
        """Metrics (M, 2, 2) of the maps' beginnings and ends, where A_i is ``metric`` (F, 2, 2)."""
        # not by metric[of], whose backward pass takes long
        own, held, n = metric.index_select(0, self.of), self.held.to(metric), self.inward
        return torch.cat([held[:n], own[n:]]), torch.cat([own[:n], held[n:]])


class CollectionQuadrature(nn.Module):
    """The meshes of k surfaces, all their triangles or, of more than 65,536, as many spread evenly.

    Args:
        meshes: uv (V, 2), in each surface's own domain, and faces (F, 3).
        surfaces: φ_j.
        domain: Ω.
        landmarks: (K, 2) in the common domain.
        targets: (k, K, 2) the same in each surface's own; NaN where it lacks the landmark.
        project: from points to the nearest ones of the common domain, if maps keep to it.
    """

    landmarks: Tensor
    targets: Tensor

    def __init__(
        self,
        meshes: Sequence[tuple[Tensor, Tensor]],
        surfaces: Sequence[nn.Module],
        domain: Any,
        landmarks: Tensor,
        targets: Tensor,
        project: Any = None,
    ) -> None:
        super().__init__()
        both = zip(meshes, surfaces, strict=True)
        self.each = nn.ModuleList(MeshQuadrature(*mesh, phi) for mesh, phi in both)
        self.domain, self.project = domain, project
        self.register_buffer("landmarks", landmarks, persistent=False)
        self.register_buffer("targets", targets, persistent=False)

    def corners(self, maps: Sequence[nn.Module]) -> list[Tensor]:
        """Those of all surfaces, :meth:`taken_back` by their maps."""
        return [self.taken_back(j, h) for j, h in enumerate(maps)]

    def _part(self, number: int) -> Triangles:
        """The triangles of a surface that are taken."""
        each: Sequence[Any] = list(self.each)
        few = sum(len(one.faces) for one in each) <= MOST
        most = MOST if few else MOST // len(each)
        part: Triangles = each[number].take(most, most)
        return part

    @torch.no_grad()
    def turn(self, number: int, maps: Sequence[nn.Module], corners: list[Tensor]) -> Turn:
        """That of the map of a surface.

        Args:
            number: of the surface.
            maps: h_j.
            corners: of each surface, :meth:`taken_back` by its map as it is now.
        """
        each: Sequence[Any] = list(self.each)
        parts = [self._part(j) for j in range(len(each))]
        ends = torch.tensor([0, *(len(part.uv) for part in parts)]).cumsum(0).tolist()
        faces = torch.cat([part.faces + n for part, n in zip(parts, ends[:-1], strict=True)])
        some = triangles(torch.cat(corners), faces, torch.cat([part.points for part in parts]))
        share = torch.cat([part.share for part in parts]) / len(parts)
        known = some.uv.isfinite().all(dim=1)[faces].all(dim=1)
        some = replace(
            some,
            uv=some.uv.nan_to_num(),
            share=share * known,
            oriented=share * (some.oriented > 0),
        )
        owner = torch.cat(
            [torch.full_like(p.share, j, dtype=torch.long) for j, p in enumerate(parts)]
        )
        inward, outward = (owner != number).nonzero()[:, 0], (owner == number).nonzero()[:, 0]
        others = [j for j in range(len(parts)) if j != number]
        own, x = parts[number], corners[number].nan_to_num()
        images = [own.forms(each[j].surface(maps[j](x))) for j in others]
        of = torch.cat([inward, *[outward] * len(others)])
        held = [some.metric[inward], *images]
        centres = torch.cat([part.centres for part in parts])
        on_surfaces = torch.cat([part.positions for part in parts])
        at = At(centres[of], on_surfaces[of])
        return Turn(number, some, of, len(inward), torch.cat(held), at, some.share[of])

    @torch.no_grad()
    def taken_back(self, number: int, h: Any) -> Tensor:
        """h⁻¹ (V, 2) of a surface's corners, NaN where none is found; landmarks in their places.

        Where h misses a landmark, what brings it there must not fold unseen between the corners.

        Args:
            number: of the surface.
            h: its map, around an affine one.
        """
        part = self._part(number)
        exact, uv = copy.deepcopy(h).cpu().double(), part.uv.cpu().double()
        x = Inverse(exact, exact.back(uv), self.project)(uv)
        off = (exact(x) - uv).norm(dim=1, keepdim=True)
        x = torch.where(off < _FOUND, x, torch.nan).to(part.uv)
        each: Any = self.each[number]
        targets = self.targets[number]
        marks = each.surface(targets.nan_to_num())
        marks = torch.where(targets.isfinite().all(dim=1, keepdim=True), marks, torch.inf)
        mode = "donot_use_mm_for_euclid_dist"
        vertex, mark = (torch.cdist(part.points, marks, compute_mode=mode) < _SAME).nonzero().T
        x[vertex] = self.domain.lift(self.landmarks[mark], x[vertex])
        return x
