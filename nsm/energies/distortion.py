"""Distortion energies of a map between surfaces, from the metrics of source and target.

Every function takes A (..., 2, 2), the source's metric on Ω, and B (..., 2, 2), the target's,
and returns one value per sample (...), in the type of its arguments. M = A⁻¹B has eigenvalues
σ₁², σ₂², the squared singular values of the map's differential; t and d are its trace and
determinant. All raise ``ValueError`` where A or B is not (..., 2, 2).

Values and gradients are finite for all finite metrics of float32 range:

* the source metric is floored as ``pullback_invariants`` says;
* energies with a root or an inverse see M + ``COLLAPSE`` I;
* the scale-free ones see σ₁/σ₂ softly capped at ``RATIO_CAP``, and a map collapsed to a point
  scores as the worst, not as a conformal one;
* values saturate at 1e30, gradients at 1e18 per entry (:mod:`nsm.energies.numerics`).

Maps with σ above 1e-2 and σ₁/σ₂ below 1e3, of source metrics above 1e-6, are altered by less
than 1e-6 of their value.

A metric carries no orientation: a map and its mirror image have the same distortion. In the plane,
where a fold is a negative det J_h, :func:`nsm.energies.constraints.injectivity` keeps the sign.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec

import torch
from torch import Tensor

from nsm.energies.metrics import Invariants, pullback_invariants
from nsm.energies.numerics import narrow, safe_sqrt

COLLAPSE = 1e-12
# METHOD's ε in the symmetric Dirichlet energy, and the least value of that: each σ adds
# σ² + 1/(σ² + ε), which is least where σ² = 1 - ε
EPSILON = 0.01
LEAST_SYMMETRIC_DIRICHLET = 4 - 2 * EPSILON
RATIO_CAP = 1e6
_VANISHING = 1e-60  # squared trace under which M is the zero matrix

P = ParamSpec("P")


def of_invariants(
    formula: Callable[Concatenate[Invariants, P], Tensor],
) -> Callable[Concatenate[Tensor, Tensor, P], Tensor]:
    """Turn a formula in the invariants of M into an energy of the two metrics."""

    @wraps(formula)
    def energy(source: Tensor, target: Tensor, *args: P.args, **kwargs: P.kwargs) -> Tensor:
        value = formula(pullback_invariants(source, target), *args, **kwargs)
        return narrow(value, torch.promote_types(source.dtype, target.dtype))

    return energy


def _aspect_squared(m: Invariants) -> Tensor:
    """(σ₁/σ₂ + σ₂/σ₁)² = t²/d, softly capped at ``RATIO_CAP``²."""
    t_squared = m.trace**2 + _VANISHING
    return t_squared / (m.determinant + t_squared / RATIO_CAP**2)


def _arap(t: Tensor, root_d: Tensor) -> Tensor:
    """Σ(σ−1)² by σ₁+σ₂ = √(t+2√d), smooth where σ₁ = σ₂, as the values themselves are not."""
    total = (t + 2 * root_d).sqrt()
    return (total - 2) ** 2 / 2 + (t - 2 * root_d).clamp(min=0) / 2


def _area(m: Invariants) -> Tensor:
    determinant = m.shifted(COLLAPSE).determinant.sqrt()
    return (determinant - 1) ** 2 + (1 / determinant - 1) ** 2


@of_invariants
def symmetric_dirichlet(m: Invariants, epsilon: float = EPSILON) -> Tensor:
    """tr(M) + tr((M + εI)⁻¹) = t + (t + 2ε)/(d + εt + ε²): METHOD, Eq. 2.

    2 + 2/(1 + ε) at an isometry, 3.9802 for ε = 0.01; its minimum 4 - 2ε = 3.98 is where
    σ₁² = σ₂² = 1 - ε. ``epsilon`` under ``COLLAPSE`` counts as ``COLLAPSE``.

    Raises:
        ValueError: ``epsilon`` is negative.
    """
    if not epsilon >= 0:
        raise ValueError(f"epsilon of the symmetric Dirichlet energy is negative: {epsilon}")
    shifted = m.shifted(max(epsilon, COLLAPSE))
    return m.trace + shifted.trace / shifted.determinant


@of_invariants
def conformal(m: Invariants) -> Tensor:
    """‖tr(M)/‖M‖² · M − I‖² = (t² − 4d)/(t² − 2d), METHOD Eq. 3: in [0, 1], zero if conformal.

    By ‖M‖² = t² − 2d, the norm of the symmetric matrix J_fᵀJ_f to which M is similar. The
    figures of at least one that the paper reports are ``singular_value_ratio``.
    """
    share = m.determinant / (m.trace**2 + _VANISHING)
    return (1 - 4 * share) / (1 - 2 * share)


@of_invariants
def singular_value_ratio(m: Invariants) -> Tensor:
    """σ₁/σ₂, at least 1: what the paper reports as conformal distortion.

    Its gradient at a conformal map, where it has none, is zero.
    """
    aspect_squared = _aspect_squared(m)
    return (aspect_squared.clamp(min=4).sqrt() + safe_sqrt(aspect_squared - 4, 1e-14)) / 2


@of_invariants
def arap(m: Invariants) -> Tensor:
    """Σ(σᵢ − 1)², the squared distance of J_f to the nearest rotation or reflection."""
    shifted = m.shifted(COLLAPSE)
    return _arap(shifted.trace, shifted.determinant.sqrt())


@of_invariants
def symmetric_arap(m: Invariants) -> Tensor:
    """Σ(σᵢ − 1)² + Σ(1/σᵢ − 1)²: ARAP of the map and of its inverse."""
    t, d = m.shifted(COLLAPSE)
    return _arap(t, d.sqrt()) + _arap(t / d, 1 / d.sqrt())


@of_invariants
def mips(m: Invariants) -> Tensor:
    """σ₁/σ₂ + σ₂/σ₁ = t/√d (Hormann and Greiner, 2000); 2 where conformal."""
    return _aspect_squared(m).sqrt()


@of_invariants
def area(m: Invariants) -> Tensor:
    """(det − 1)² + (1/det − 1)², authalic: zero where areas are kept.

    det = σ₁σ₂ = √d is the ratio of areas of target and source, and never negative: between
    surfaces in space it has no sign to lose.
    """
    return _area(m)


@of_invariants
def dirichlet(m: Invariants) -> Tensor:
    """t/2 = (σ₁² + σ₂²)/2: harmonic maps are its critical points."""
    return m.trace / 2


@of_invariants
def equiareal_conformal(m: Invariants, blend: float = 0.5) -> Tensor:
    """(1 − λ)·(MIPS/2 − 1) + λ·area, λ = ``blend``: angles at 0, areas at 1; zero at isometry.

    MIPS stands for angles, as it grows without bound as ``area`` does, where Eq. 3 ends at 1.

    Raises:
        ValueError: ``blend`` is not in [0, 1].
    """
    if not 0 <= blend <= 1:
        raise ValueError(f"blend of the equiareal-conformal energy is not in [0, 1]: {blend}")
    angles = (_aspect_squared(m).sqrt() / 2 - 1).clamp(min=0)
    return (1 - blend) * angles + blend * _area(m)
