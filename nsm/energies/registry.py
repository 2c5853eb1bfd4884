"""Distortion energies as objects: callables of metrics, alone or in a weighted sum."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from nsm.energies import distortion


class At(NamedTuple):
    """Where samples are; either may be unknown.

    Attributes:
        uv: (..., 2), in Ω.
        position: (..., 3), on the source surface.
    """

    uv: Tensor | None = None
    position: Tensor | None = None


# of A and B (..., 2, 2) and, if it takes it, At, to (...)
Energy = Callable[..., Tensor]


@dataclass(frozen=True)
class _OfMetrics:
    """An energy of this room as an object; its fields are the parameters of ``formula``.

    ``scale_free``: whether the map and its multiples have one energy.
    """

    formula: ClassVar[Callable[..., Tensor]]
    scale_free: ClassVar[bool] = False

    def __post_init__(self) -> None:
        isometry = torch.eye(2)
        self(isometry, isometry)  # ValueError for a parameter out of range

    def __call__(self, source: Tensor, target: Tensor, at: At | None = None) -> Tensor:
        return type(self).formula(source, target, **vars(self))


@dataclass(frozen=True)
class SymmetricDirichlet(_OfMetrics):
    """METHOD, Eq. 2 (see :func:`nsm.energies.symmetric_dirichlet`).

    Args:
        epsilon: ε, not negative; bounds the cost of a collapse.

    Raises:
        ValueError: ε is negative.
    """

    formula = staticmethod(distortion.symmetric_dirichlet)
    epsilon: float = 0.01


@dataclass(frozen=True)
class Conformal(_OfMetrics):
    """METHOD, Eq. 3 (see :func:`nsm.energies.conformal`)."""

    formula = staticmethod(distortion.conformal)
    scale_free = True


@dataclass(frozen=True)
class SingularValueRatio(_OfMetrics):
    """σ₁/σ₂ (see :func:`nsm.energies.singular_value_ratio`)."""

    formula = staticmethod(distortion.singular_value_ratio)
    scale_free = True


@dataclass(frozen=True)
class ARAP(_OfMetrics):
    """As rigid as possible (see :func:`nsm.energies.arap`)."""

    formula = staticmethod(distortion.arap)


@dataclass(frozen=True)
class SymmetricARAP(_OfMetrics):
    """As rigid as possible, both ways (see :func:`nsm.energies.symmetric_arap`)."""

    formula = staticmethod(distortion.symmetric_arap)


@dataclass(frozen=True)
class MIPS(_OfMetrics):
    """σ₁/σ₂ + σ₂/σ₁ (see :func:`nsm.energies.mips`)."""

    formula = staticmethod(distortion.mips)
    scale_free = True


@dataclass(frozen=True)
class Area(_OfMetrics):
    """Change of area (see :func:`nsm.energies.area`)."""

    formula = staticmethod(distortion.area)


@dataclass(frozen=True)
class Dirichlet(_OfMetrics):
    """(σ₁² + σ₂²)/2 (see :func:`nsm.energies.dirichlet`)."""

    formula = staticmethod(distortion.dirichlet)


@dataclass(frozen=True)
class EquiarealConformal(_OfMetrics):
    """Angles and areas in one (see :func:`nsm.energies.equiareal_conformal`).

    Args:
        blend: in [0, 1]; angles alone at 0, areas alone at 1.

    Raises:
        ValueError: ``blend`` is out of range.
    """

    formula = staticmethod(distortion.equiareal_conformal)
    blend: float = 0.5


_KINDS = (
    *(SymmetricDirichlet, Conformal, SingularValueRatio, ARAP, SymmetricARAP, MIPS, Area),
    *(Dirichlet, EquiarealConformal),
)
ENERGIES: dict[str, Callable[..., Energy]] = {kind.formula.__name__: kind for kind in _KINDS}


def _with_at(energy: Energy) -> Callable[[Tensor, Tensor, At | None], Tensor]:
    """An energy as a function of three arguments; one that takes no ``at`` does not get it."""
    try:
        parameters = inspect.signature(energy).parameters
    except ValueError:  # functions in C have no signature
        parameters = inspect.Signature().parameters
    if "at" in parameters:
        return lambda source, target, at: energy(source, target, at=at)
    needed = [p for p in parameters.values() if p.default is p.empty and p.kind <= 1]
    if len(needed) == 3:
        return lambda source, target, at: energy(source, target, at)
    return lambda source, target, at: energy(source, target)


def call_energy(energy: Energy, source: Tensor, target: Tensor, at: At | None = None) -> Tensor:
    """An energy at samples, whether it takes ``at`` or the metrics alone.

    Args:
        energy: of (source, target) or (source, target, at).
        source, target: metrics A and B (..., 2, 2).
        at: where the samples are.

    Returns:
        (...).
    """
    return _with_at(energy)(source, target, at)


class Blend:
    """Σ wᵢ·Eᵢ, as a function of the metrics A and B.

    Args:
        weights: name of an energy to its weight.
        terms: name to energy, for those of the user's own or with parameters; the other names
            are those of ``ENERGIES``, with default parameters.

    Attributes:
        weights: the same, as floats.

    Raises:
        ValueError: there are no weights, a name is not known, a term has no weight, or a weight is
            negative or not finite.
    """

    def __init__(
        self, weights: Mapping[str, float], terms: Mapping[str, Energy] | None = None
    ) -> None:
        terms = dict(terms or {})
        if not weights:
            raise ValueError("energy.weights: a blend needs at least one weight")
        for name in terms:
            if name not in weights:
                raise ValueError(f"energy.terms: {name!r} has no weight in energy.weights")
        for name, weight in weights.items():
            if name not in terms and name not in ENERGIES:
                nearest = get_close_matches(str(name), ENERGIES, n=1, cutoff=0.0)[0]
                raise ValueError(
                    f"energy {name!r} is not known: did you mean {nearest!r}? known are "
                    f"{', '.join(ENERGIES)}, and the names in energy.terms"
                )
            if not (math.isfinite(weight) and weight >= 0):
                raise ValueError(f"weight of energy {name!r} is negative or not finite: {weight}")
        self.weights = {name: float(weight) for name, weight in weights.items()}
        self._energies = {
            name: _with_at(terms[name] if name in terms else ENERGIES[name]()) for name in weights
        }

    def parts(self, source: Tensor, target: Tensor, at: At | None = None) -> dict[str, Tensor]:
        """Each energy by name, without its weight: metrics A and B (..., 2, 2) to (...)."""
        return {name: term(source, target, at) for name, term in self._energies.items()}

    def total(self, parts: Mapping[str, Tensor]) -> Tensor:
        """Σ wᵢ·Eᵢ of what ``parts`` gave."""
        first, *rest = (self.weights[name] * part for name, part in parts.items())
        return sum(rest, start=first)

    def __call__(self, source: Tensor, target: Tensor, at: At | None = None) -> Tensor:
        """Σ wᵢ·Eᵢ: metrics A and B (..., 2, 2) to (...)."""
        return self.total(self.parts(source, target, at))
