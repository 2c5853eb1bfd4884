"""Matrices that the tests of the energies share."""

import math

import torch


def jacobians(n, rows, seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, rows, 2, generator=generator, dtype=torch.float64)


def metric(j):
    return j.transpose(-1, -2) @ j


def with_singular_values(first, second, n=20, seed=0):
    """Metrics A, B (n, 2, 2) of maps whose differential has these singular values, else random."""
    source = jacobians(n, 3, seed)
    frame, r = torch.linalg.qr(source)
    angle = torch.rand(n, generator=torch.Generator().manual_seed(seed)).double() * math.tau
    turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).view(n, 2, 2)
    stretch = torch.diag(torch.tensor([first, second], dtype=torch.float64))
    return metric(source), metric(stretch @ turn @ r)


def extreme_metrics():
    """Float32 metrics of every size and rank, zero and the largest number among them."""
    sizes = [0.0, 1e-45, 1e-38, 1e-30, 1e-12, 1e-7, 1e-3, 1.0, 1e3, 1e12, 1e18, 1e30, 3.4e38]
    correlations = [-1.0, -0.999999, 0.0, 0.5, 1.0]
    return torch.tensor(
        [
            [[x, c * math.sqrt(x) * math.sqrt(y)], [c * math.sqrt(x) * math.sqrt(y), y]]
            for x in sizes
            for y in sizes
            for c in correlations
        ]
    )


class Disc:
    """The unit disc, as constraints and inverses see it."""

    def signed_distance(self, points):
        return torch.linalg.vector_norm(points, dim=-1) - 1

    def project(self, points):
        return points / torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp(min=1)


class Square:
    """The square [−1, 1]², as constraints and inverses see it."""

    def signed_distance(self, points):
        q = points.abs() - 1
        return torch.linalg.vector_norm(q.clamp(min=0), dim=-1) + q.amax(dim=-1).clamp(max=0)

    def project(self, points):
        return points.clamp(-1, 1)
