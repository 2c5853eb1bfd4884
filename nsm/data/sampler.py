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
    """Fresh points in each step, batches from a fixed pool, or batches that come again.

    Args:
        vertex_share: share of a batch that are random mesh vertices, in [0, 1].
        domain_share: share of a batch that is uniform in Ω instead of by area, in [0, 1]. Errors
            are not weighted: the share says how much each part of the surface counts. The two
            shares add up to at most 1; the rest of a batch is uniform by area.
        pool: None: draw afresh in each step; a number: draw so many points once, all vertices
            among them unless each batch has them, and pick the batches from these.
        batches: a number: each step takes one of so many batches, at random, so that what does not
            change at their points is evaluated once; None: other points in each step.
        every_vertex: all mesh vertices are in each batch, beside its other points.
        stratified: spread the points that are uniform by area evenly, one to each of as many parts
            of equal area.

    Raises:
        ValueError: a share outside [0, 1], a sum above 1, a pool below 1, or fewer batches than 1.
    """

    def __init__(
        self,
        vertex_share: Share = 0.0,
        domain_share: Share = 0.0,
        pool: Count | None = None,
        stratified: bool = False,
        every_vertex: bool = False,
        batches: Count | None = None,
    ) -> None:
        for name, share in (("vertex_share", vertex_share), ("domain_share", domain_share)):
            if not 0 <= share <= 1:
                raise ValueError(f"{name} {share} is not in [0, 1]")
        if vertex_share + domain_share > 1:
            raise ValueError("vertex_share and domain_share add up to more than 1")
        if pool is not None and pool < 1:
            raise ValueError(f"pool {pool} is not at least 1")
        if batches is not None and batches < 1:
            raise ValueError(f"batches {batches} is not at least 1")
        self.vertex_share, self.domain_share, self.pool = vertex_share, domain_share, pool
        self.stratified, self.every_vertex = stratified, every_vertex
        self.fixed: Samples | None = None
        self.batches, self.seed = batches, 0
        self.known: dict[tuple[int, int], Samples] = {}

    def setup(self, surface: SurfaceSampler, seed: int) -> None:
        """Prepare for a surface: draw the pool, if there is to be one."""
        self.seed, self.known = seed, {}
        if self.pool is not None:
            points = surface.by_area if self.every_vertex else surface.pool
            self.fixed = points(self.pool, surface.generator(seed, -1))

    def draw(self, surface: SurfaceSampler, count: int, generator: torch.Generator) -> Samples:
        """``count`` points of a surface, and all its vertices with ``every_vertex``."""
        if self.batches is None:
            return self._batch(surface, count, generator)
        number = int(torch.randint(self.batches, (), generator=generator, device=surface.device))
        if (number, count) not in self.known:
            own = surface.generator(self.seed, -2 - number)  # -1 is the pool's
            self.known[number, count] = self._batch(surface, count, own)
        return self.known[number, count]

    def _batch(self, surface: SurfaceSampler, count: int, generator: torch.Generator) -> Samples:
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
