"""Terms that constrain a planar map h: the boundary of Ω, injectivity, landmarks.

Points are (..., 2), values (...), in the type of the points; all are finite in value and
gradient for finite points.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

from nsm.energies.numerics import narrow, widen
from nsm.energies.squared_distance import squared_distance

STEEPEST = 20.0  # the injectivity term grows as exp until det = −STEEPEST, then linearly


class Bounded(Protocol):
    """A domain Ω of the plane."""

    def signed_distance(self, points: Tensor) -> Tensor:
        """Distance (...) of points (..., 2) to ∂Ω, negative inside."""
        ...


def _distance(domain: Bounded, p: Tensor) -> Tensor:
    if p.shape[-1:] != (2,):
        raise ValueError(f"points of the plane are (..., 2), not {tuple(p.shape)}")
    return domain.signed_distance(widen(p))


def inside(domain: Bounded, p: Tensor, tolerance: float = 0.0) -> Tensor:
    """Mask (...) of the points of Ω, boundary included, widened by ``tolerance``.

    Args:
        domain: Ω.
        p: (..., 2).
        tolerance: a distance.

    Raises:
        ValueError: p is not (..., 2).
    """
    return _distance(domain, p) <= tolerance


def boundary(domain: Bounded, p: Tensor) -> Tensor:
    """Squared signed distance σ(p) to ∂Ω, METHOD (B): zero on ∂Ω, so that the image may slide.

    Raises:
        ValueError: p is not (..., 2).
    """
    return narrow(_distance(domain, p) ** 2, p.dtype)


def outside(domain: Bounded, p: Tensor) -> Tensor:
    """Squared distance to Ω: zero inside, it pulls back samples that h sent out.

    Raises:
        ValueError: p is not (..., 2).
    """
    return narrow(_distance(domain, p).clamp(min=0) ** 2, p.dtype)


def injectivity(det: Tensor) -> Tensor:
    """max(−sign(det)·exp(−det), 0), METHOD (G): zero for det ≥ 0, exp(−det) where h folds.

    Under det = −``STEEPEST`` the exponential goes on along its tangent, e^S·(1 − det − S).

    Args:
        det: (...), determinants of J_h.

    Returns:
        (...), of the type of ``det``.
    """
    depth = -widen(det)
    exponential = depth.clamp(max=STEEPEST).exp()
    tangent = math.exp(STEEPEST) * (depth - STEEPEST).clamp(min=0)
    return narrow(torch.where(depth > 0, exponential + tangent, 0.0), det.dtype)


def unfold(det: Tensor, margin: float = 0.1) -> Tensor:
    """((margin − det) / margin)² below the margin, zero above it; below zero along its tangent.

    ``injectivity`` has a gradient only where a triangle is flipped; this term pushes it beyond.

    Args:
        det: (...), determinants of J_h, or signed areas of triangles relative to their own.
        margin: in (0, 1].

    Returns:
        (...), of the type of ``det``.
    """
    depth = (margin - widen(det)).clamp(min=0) / margin
    return narrow(torch.where(depth > 1, 2 * depth - 1, depth**2), det.dtype)


def landmark(points: Tensor, targets: Tensor) -> Tensor:
    """‖h(P_i) − Q_i‖², METHOD (C).

    Args:
        points: h(P), (L, n); L may be zero.
        targets: Q, (L, n).

    Returns:
        (L,).

    Raises:
        ValueError: the shapes differ.
    """
    return squared_distance(points, targets, "landmarks")
