"""Distortion energies by name, with their parameters, alone or mixed."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torch import Tensor

from nsm.energies import distortion
from nsm.energies.naming import look_up

Energy = Callable[[Tensor, Tensor], Tensor]

ENERGIES: dict[str, Callable[..., Tensor]] = {
    "symmetric_dirichlet": distortion.symmetric_dirichlet,
    "conformal": distortion.conformal,
    "singular_value_ratio": distortion.singular_value_ratio,
    "arap": distortion.arap,
    "symmetric_arap": distortion.symmetric_arap,
    "mips": distortion.mips,
    "area": distortion.area,
    "dirichlet": distortion.dirichlet,
    "equiareal_conformal": distortion.equiareal_conformal,
}


def energy(name: str, **parameters: Any) -> Energy:
    """The energy of that name, as a function of the metrics A and B (..., 2, 2) to (...).

    Args:
        name: a key of ``ENERGIES``.
        **parameters: its parameters (``epsilon`` of ``symmetric_dirichlet``, ``blend`` of
            ``equiareal_conformal``); their values are checked when the energy is evaluated.

    Raises:
        ValueError: the name (the message gives the nearest) or a parameter is not known.
    """
    function = look_up(ENERGIES, name, "energy")
    known = {key: None for key in list(inspect.signature(function).parameters)[1:]}
    for key in parameters:
        if not known:
            raise ValueError(f"energy {name!r} takes no parameters, and was given {key!r}")
        look_up(known, key, f"parameter of energy {name!r}")
    return partial(function, **parameters)


class Blend:
    """Σ wᵢ·Eᵢ, with the energies' default parameters; as a function of the metrics A and B.

    Args:
        weights: name of an energy to its weight.

    Attributes:
        weights: the same, as floats.

    Raises:
        ValueError: there are no weights, a name is not known, or a weight is negative or not
            finite.
    """

    def __init__(self, weights: Mapping[str, float]) -> None:
        if not weights:
            raise ValueError("a blend of energies needs at least one weight")
        for name, weight in weights.items():
            if not (math.isfinite(weight) and weight >= 0):
                raise ValueError(f"weight of energy {name!r} is negative or not finite: {weight}")
        self.weights = {name: float(weight) for name, weight in weights.items()}
        self._energies = {name: energy(name) for name in weights}

    def parts(self, source: Tensor, target: Tensor) -> dict[str, Tensor]:
        """Each energy by name, without its weight: metrics A and B (..., 2, 2) to (...)."""
        return {name: term(source, target) for name, term in self._energies.items()}

    def total(self, parts: Mapping[str, Tensor]) -> Tensor:
        """Σ wᵢ·Eᵢ of what ``parts`` gave."""
        first, *rest = (self.weights[name] * part for name, part in parts.items())
        return sum(rest, start=first)

    def __call__(self, source: Tensor, target: Tensor) -> Tensor:
        """Σ wᵢ·Eᵢ: metrics A and B (..., 2, 2) to (...)."""
        return self.total(self.parts(source, target))
