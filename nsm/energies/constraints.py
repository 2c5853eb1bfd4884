"""Terms that hold a planar map h in place: the boundary of Ω, injectivity, landmarks.

Points are (..., 2), values (...), in the type of the points; all are finite in value and
gradient for finite points. Ω is the unit disc or the square [−1, 1]².
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from nsm.energies.naming import look_up
from nsm.energies.numerics import narrow, widen

STEEPEST = 20.0  # the injectivity term grows as exp until det = −STEEPEST, then linearly


def _disc(p: Tensor) -> Tensor:
    # vector_norm, unlike a root of squares, has a gradient (zero) at the centre
    return torch.linalg.vector_norm(p, dim=-1) - 1


def _square(p: Tensor) -> Tensor:
    q = p.abs() - 1
    beyond = torch.linalg.vector_norm(q.clamp(min=0), dim=-1)
    return beyond + q.amax(dim=-1).clamp(max=0)


DOMAINS: dict[str, Callable[[Tensor], Tensor]] = {"disc": _disc, "square": _square}


def _distance(domain: str, p: Tensor) -> Tensor:
    if p.shape[-1:] != (2,):
        raise ValueError(f"points of the plane are (..., 2), not {tuple(p.shape)}")
    return look_up(DOMAINS, domain, "domain")(widen(p))


def signed_distance(domain: str, p: Tensor) -> Tensor:
    """Euclidean distance of p (..., 2) to the boundary of Ω, negative inside.

    Args:
        domain: ``disc`` or ``square``.
        p: (..., 2).

    Raises:
        ValueError: the domain is not known, or p is not (..., 2).
    """
    return narrow(_distance(domain, p), p.dtype)


def inside(domain: str, p: Tensor, tolerance: float = 0.0) -> Tensor:
    """Mask (...) of the points of Ω, boundary included, widened by ``tolerance``.

    Raises:
        ValueError: as ``signed_distance``.
    """
    return _distance(domain, p) <= tolerance


def boundary(domain: str, p: Tensor) -> Tensor:
    """Squared signed distance σ(p) to ∂Ω, METHOD (B): zero on ∂Ω, so that the image may slide.

    Raises:
        ValueError: as ``signed_distance``.
    """
    return narrow(_distance(domain, p) ** 2, p.dtype)


def outside(domain: str, p: Tensor) -> Tensor:
    """Squared distance to Ω: zero inside, it pulls back samples that h sent out.

    Raises:
        ValueError: as ``signed_distance``.
    """
    return narrow(_distance(domain, p).clamp(min=0) ** 2, p.dtype)


def boundary_disc(p: Tensor) -> Tensor:
    """``boundary`` of the unit disc: (‖p‖ − 1)²."""
    return boundary("disc", p)


def boundary_square(p: Tensor) -> Tensor:
    """``boundary`` of the square [−1, 1]²; points slide along sides, corners do not hold them."""
    return boundary("square", p)


def outside_disc(p: Tensor) -> Tensor:
    """``outside`` of the unit disc: max(‖p‖ − 1, 0)²."""
    return outside("disc", p)


def outside_square(p: Tensor) -> Tensor:
    """``outside`` of the square [−1, 1]²."""
    return outside("square", p)


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
    """((margin − det) / margin)² under the margin, zero above it; under zero along its tangent.

    ``injectivity`` lets go of a triangle as soon as it is not flipped, and has no gradient until
    it is; this one clears the way.

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
    if points.shape != targets.shape:
        raise ValueError(
            f"landmarks {tuple(points.shape)} and their targets {tuple(targets.shape)} differ"
        )
    return narrow(((widen(points) - widen(targets)) ** 2).sum(dim=-1), points.dtype)
