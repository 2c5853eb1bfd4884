"""Random points of a surface, drawn where the training happens."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nsm.domains import Surface
from nsm.surfaces.topology import edges_of


class Samples(NamedTuple):
    """Points of a surface: uv (N, 2) in Ω, points (N, 3), unit normals (N, 3)."""

    uv: Tensor
    points: Tensor
    normals: Tensor


class SurfaceSampler:
    """Draws points of a surface on a device, uniformly by area on the mesh or in Ω.

    Args:
        surface: the prepared surface.
        device: where the samples are wanted.
    """

    def __init__(self, surface: Surface, device: torch.device | str = "cpu") -> None:
        self.device = torch.device(device)
        self.vertices = torch.as_tensor(surface.vertices, dtype=torch.float32, device=self.device)
        self.uv = torch.as_tensor(surface.uv, dtype=torch.float32, device=self.device)
        self.faces = torch.as_tensor(surface.faces, device=self.device)
        a, b, c = self.vertices[self.faces].unbind(dim=1)
        cross = torch.linalg.cross(b - a, c - a)
        double_area = cross.norm(dim=1)
        self.normals = cross / double_area.clamp_min(1e-30)[:, None]
        self.cumulative_area = _cumulative(double_area)
        weighted = torch.zeros_like(self.vertices)
        weighted.index_add_(0, self.faces.reshape(-1), cross.repeat_interleave(3, dim=0))
        self.has_boundary = surface.domain.has_boundary
        if not self.has_boundary:
            # copies of a vertex are one point of a smooth surface
            first, faces = surface.whole()
            again = torch.empty(len(self.vertices), dtype=torch.int64, device=self.device)
            again[self.faces] = torch.as_tensor(faces, device=self.device)
            whole = torch.zeros_like(self.vertices[: len(first)]).index_add_(0, again, weighted)
            weighted = whole[again]
        self.vertex_normals = weighted / weighted.norm(dim=1, keepdim=True).clamp_min(1e-30)

    @cached_property
    def cumulative_domain_area(self) -> Tensor:
        """(F,) of the triangles up to each: share of Ω."""
        a, b, c = self.uv[self.faces].double().unbind(dim=1)
        u, v = b - a, c - a
        return _cumulative((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).abs())

    def generator(self, seed: int, step: int = 0) -> torch.Generator:
        """The source of randomness of one step: samples depend on (seed, step) and nothing else,
        which is what lets interrupted work resume to the same result."""
        generator = torch.Generator(device=self.device)
        generator.manual_seed((seed * 1_000_003 + step) % (2**63))
        return generator

    def by_area(self, count: int, generator: torch.Generator, stratified: bool = False) -> Samples:
        """``count`` points, uniform by area of the mesh.

        Stratified, one lies in each of ``count`` parts of equal area, so that sums over them vary
        less; parts consist of triangles that follow each other.
        """
        if not stratified:
            return self._at(*self._places(count, generator))
        weights = self._places(count, generator)[1]
        return self._at(self._one_in_each_part(count, generator), weights)

    def _one_in_each_part(self, count: int, generator: torch.Generator) -> Tensor:
        """Faces (count,), rising: one random point's in each of ``count`` parts of equal area."""
        dice = torch.rand(count, generator=generator, device=self.device, dtype=torch.float64)
        parts = torch.arange(count, device=self.device, dtype=torch.float64)
        face = torch.searchsorted(self.cumulative_area, (parts + dice) / count)
        return face.clamp(max=len(self.faces) - 1)

    def with_jacobian(
        self, count: int, boundary_every: int, generator: torch.Generator
    ) -> tuple[Samples, Tensor]:
        """``count`` points, and the Jacobian (N, 3, 2) of f: Ω → mesh there; zero where a triangle
        has no area in Ω in single precision.

        The first of every ``boundary_every`` points is on the mesh's boundary, uniform by length;
        the others are uniform by area, and spread evenly. On a closed domain all are. Their order
        is random.
        """
        weights = self._weights(count, generator)
        order = torch.randperm(count, generator=generator, device=self.device)
        face = self._one_in_each_part(count, generator)[order]
        if self.has_boundary:
            on = slice(None, None, boundary_every)
            face[on], weights[on] = self._boundary_places(len(face[on]), generator)
        return self._at(face, weights), self._jacobians[face]

    @cached_property
    def _jacobians(self) -> Tensor:
        """(F, 3, 2) of f: Ω → mesh on each triangle; zero where it has no area in Ω."""
        plane, space = self.uv[self.faces].double(), self.vertices[self.faces].double()
        sides = torch.stack([plane[:, 1] - plane[:, 0], plane[:, 2] - plane[:, 0]], dim=2)
        edges = torch.stack([space[:, 1] - space[:, 0], space[:, 2] - space[:, 0]], dim=2)
        jacobian = torch.linalg.solve_ex(sides, edges, left=False).result.to(self.vertices.dtype)
        finite = torch.isfinite(jacobian).flatten(1).all(dim=1)[:, None, None]
        return torch.where(finite, jacobian, 0.0)

    def _boundary_places(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Faces (N,) and barycentric weights (N, 3) of points uniform by length on the boundary."""
        edges = edges_of(self.faces.cpu().numpy())
        faces, corners = torch.as_tensor(
            np.stack(np.nonzero(edges.count[edges.of_corner] == 1)), device=self.device
        )
        ends = [self.vertices[self.faces[faces, (corners + k) % 3]] for k in range(2)]
        dice = torch.rand(2, count, generator=generator, device=self.device, dtype=torch.float64)
        side = torch.searchsorted(_cumulative((ends[1] - ends[0]).norm(dim=1)), dice[0])
        side, along = side.clamp(max=len(faces) - 1), dice[1].to(self.vertices.dtype)
        weights = torch.zeros(count, 3, device=self.device)
        row, corner = torch.arange(count, device=self.device), corners[side]
        weights[row, corner], weights[row, (corner + 1) % 3] = 1 - along, along
        return faces[side], weights

    def _places(
        self, count: int, generator: torch.Generator, cumulative: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Faces (N,) and barycentric weights (N, 3) of points that are uniform by area, or by
        another measure of the faces, given as its share of all faces up to each (M,)."""
        cumulative = self.cumulative_area if cumulative is None else cumulative
        dice = torch.rand(count, generator=generator, device=self.device, dtype=torch.float64)
        face = torch.searchsorted(cumulative, dice).clamp(max=len(self.faces) - 1)
        return face, self._weights(count, generator)

    def _weights(self, count: int, generator: torch.Generator) -> Tensor:
        """Barycentric weights (count, 3) of points that are uniform in their triangles."""
        r = torch.rand(count, 2, generator=generator, device=self.device)
        root = r[:, 0].sqrt()
        return torch.stack([1 - root, root * (1 - r[:, 1]), root * r[:, 1]], dim=1)

    def _at(self, face: Tensor, weights: Tensor) -> Samples:
        corners = self.faces[face]
        return Samples(
            uv=(weights[:, :, None] * self.uv[corners]).sum(dim=1),
            points=(weights[:, :, None] * self.vertices[corners]).sum(dim=1),
            normals=self.normals[face],
        )

    def at_vertices(self, index: Tensor) -> Samples:
        """Samples at the given vertices (N,), with area-weighted vertex normals."""
        return Samples(self.uv[index], self.vertices[index], self.vertex_normals[index])

    def in_domain(self, count: int, generator: torch.Generator) -> Samples:
        """``count`` points, uniform in Ω."""
        return self._at(*self._places(count, generator, self.cumulative_domain_area))

    def pool(self, count: int, generator: torch.Generator) -> Samples:
        """A fixed set: all vertices and, by area, what is missing to ``count``."""
        everywhere = torch.arange(len(self.vertices), device=self.device)
        rest = self.by_area(max(count - len(everywhere), 0), generator)
        return join(rest, self.at_vertices(everywhere))


def _cumulative(areas: Tensor) -> Tensor:
    """Of the faces (or sides) up to each: share of the whole area (or length)."""
    # summed in float64: with a million faces a float32 sum would lose the small ones
    cumulative = areas.double().cumsum(0)
    return cumulative / cumulative[-1]


def join(a: Samples, b: Samples) -> Samples:
    """The points of both."""
    return Samples(*(torch.cat(pair) for pair in zip(a, b, strict=True)))
