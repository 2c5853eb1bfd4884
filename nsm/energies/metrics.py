"""Metrics of Ω, and the two numbers that every distortion of a map between surfaces needs.

With A the metric that the source surface induces on Ω and B the target's, the differential J_f
of the map satisfies J_fᵀJ_f ~ A⁻¹B (similar matrices), so trace and determinant of A⁻¹B give
both singular values without a tangent frame.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from nsm.energies.compiled_metrics import Form, PullbackInvariants
from nsm.energies.numerics import GRADIENT_LIMIT, widen
from nsm.tensors import suit_compiled

# Added to A's diagonal: a source metric this small is a collapsed surface (areas are about π),
# and larger ones, from 1e-6 up, are altered by less than 1e-6 of themselves.
SOURCE_FLOOR = 1e-12


class Invariants(NamedTuple):
    """Trace t = σ₁² + σ₂² and determinant d = σ₁²σ₂² of M = A⁻¹B; each (...), float64."""

    trace: Tensor
    determinant: Tensor

    def shifted(self, epsilon: float) -> Invariants:
        """The invariants of M + ``epsilon`` I."""
        t, d = self
        return Invariants(t + 2 * epsilon, d + epsilon * t + epsilon**2)


def first_fundamental_form(jacobian: Tensor) -> Tensor:
    """JᵀJ, the metric that a map induces on Ω.

    Args:
        jacobian: (..., 3, 2) of a surface or (..., 2, 2) of a planar map; entries below 1e18 in
            float32. Squaring doubles the digits that a slender Jacobian loses: where σ₁/σ₂
            passes 1e3, give it in float64.

    Returns:
        (..., 2, 2), symmetric positive semidefinite, of the type of ``jacobian``.

    Raises:
        ValueError: the last axis does not hold two columns.
    """
    if jacobian.ndim < 2 or jacobian.shape[-1] != 2:
        raise ValueError(f"a Jacobian is (..., n, 2), not {tuple(jacobian.shape)}")
    if suit_compiled(jacobian):
        form: Tensor = Form.apply(jacobian)
        return form
    return jacobian.mT @ jacobian


def determinant(matrix: Tensor) -> Tensor:
    """det (...) of matrices (..., 2, 2), in a fraction of the time of ``torch.linalg.det``."""
    a, b, c, d = matrix.flatten(-2).unbind(dim=-1)
    return a * d - b * c


def pullback_invariants(source: Tensor, target: Tensor) -> Invariants:
    """Trace and determinant of A⁻¹B.

    Finite in value and gradient for all finite A and B of float32 range. A gains
    ``SOURCE_FLOOR`` on its diagonal, and det A is held above ε·(tr A)², ε the machine epsilon of
    the type in which A came: a smaller determinant is rounding noise. Only the symmetric parts
    of A and B are read.

    Args:
        source: A (..., 2, 2), positive semidefinite.
        target: B (..., 2, 2), positive semidefinite.

    Returns:
        ``Invariants`` in float64, 0 ≤ d ≤ t²/4.

    Raises:
        ValueError: a metric is not (..., 2, 2).
    """
    for metric in (source, target):
        if metric.shape[-2:] != (2, 2):
            raise ValueError(f"a metric is (..., 2, 2), not {tuple(metric.shape)}")
    if source.shape == target.shape and suit_compiled(source, target):
        plain = _invariants
        found = PullbackInvariants.apply(source, target, plain, SOURCE_FLOOR, GRADIENT_LIMIT)
        return Invariants(*found)
    return Invariants(*_invariants(source, target))


def _invariants(source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`pullback_invariants`, by operations on tensors."""
    a, b, c = _entries(source)
    e, f, g = _entries(target)
    a, c = a + SOURCE_FLOOR, c + SOURCE_FLOOR
    trace_a = (a + c).clamp(min=2 * SOURCE_FLOOR)
    det_a = torch.maximum(a * c - b * b, torch.finfo(source.dtype).eps * trace_a**2)
    trace = ((c * e - 2 * b * f + a * g) / det_a).clamp(min=0)
    determinant = ((e * g - f * f) / det_a).clamp(min=0)
    # d ≤ t²/4 for every pair of metrics; rounding of a collapsed one must not break it
    return trace, torch.minimum(determinant, trace**2 / 4)


def _entries(metric: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    a, b, c, d = widen(metric).flatten(-2).unbind(dim=-1)
    return a, (b + c) / 2, d
