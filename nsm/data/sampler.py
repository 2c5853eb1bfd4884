"""Which points of a surface make a batch."""

from __future__ import annotations

from typing import Protocol

import torch

from nsm.data.sampling import Samples, SurfaceSampler, join
from nsm.settings import Count, Share


class Draws(Protocol):
    """What a sampler is: a user's own class needs this method alone."""

    def draw(self, surface: SurfaceSampler, count: int, generator: torch.Generator) -> Samples:
        """``count`` points of a surface, a function of the generator's state alone."""
        ...


class Sampler:
    """Fresh points in each step, or batches from a fixed pool.

    Args:
        vertex_share: share of a batch that are random mesh vertices, in [0, 1].
        domain_share: share of a batch that is uniform in Ω instead of by area, in [0, 1]. Errors
            are not weighted: the share says how much each part of the surface counts. The two
            shares add up to at most 1; the rest of a batch is uniform by area.
        pool: None: draw afresh in each step; a number: draw so many points once, all vertices
            among them unless each batch has them, and pick the batches from these.
        every_vertex: all mesh vertices are in each batch, beside its other points.
        stratified: spread the points that are uniform by area evenly, one to each of as many parts
            of equal area.

    Raises:
        ValueError: a share outside [0, 1], a sum above 1, or a pool below 1.
    """

    def __init__(
        self,
        vertex_share: Share = 0.0,
        domain_share: Share = 0.0,
        pool: Count | None = None,
        stratified: bool = False,
        every_vertex: bool = False,
    ) -> None:
        for name, share in (("vertex_share", vertex_share), ("domain_share", domain_share)):
            if not 0 <= share <= 1:
                raise ValueError(f"{name} {share} is not in [0, 1]")
        if vertex_share + domain_share > 1:
            raise ValueError("vertex_share and domain_share add up to more than 1")
        if pool is not None and pool < 1:
            raise ValueError(f"pool {pool} is not at least 1")
        self.vertex_share, self.domain_share, self.pool = vertex_share, domain_share, pool
        self.stratified, self.every_vertex = stratified, every_vertex
        self.fixed: Samples | None = None

    def setup(self, surface: SurfaceSampler, seed: int) -> None:
        """Draw the pool of a surface, if there is to be one."""
        if self.pool is not None:
            points = surface.by_area if self.every_vertex else surface.pool
            self.fixed = points(self.pool, surface.generator(seed, -1))

    def draw(self, surface: SurfaceSampler, count: int, generator: torch.Generator) -> Samples:
        """``count`` points of a surface, and all its vertices with ``every_vertex``."""
        samples = self._drawn(surface, count, generator)
        if self.every_vertex:
            everywhere = torch.arange(len(surface.vertices), device=surface.device)
            samples = join(samples, surface.at_vertices(everywhere))
        return samples

    def _drawn(self, surface: SurfaceSampler, count: int, generator: torch.Generator) -> Samples:
        if self.fixed is not None:
            index = torch.randint(
                len(self.fixed.uv), (count,), generator=generator, device=surface.device
            )
            return Samples(*(part[index] for part in self.fixed))
        at_vertices = round(count * self.vertex_share)
        in_domain = min(round(count * self.domain_share), count - at_vertices)
        samples = surface.by_area(count - at_vertices - in_domain, generator, self.stratified)
        if in_domain:
            samples = join(samples, surface.in_domain(in_domain, generator))
        if at_vertices:
            index = torch.randint(
                len(surface.vertices), (at_vertices,), generator=generator, device=surface.device
            )
            samples = join(samples, surface.at_vertices(index))
        return samples
