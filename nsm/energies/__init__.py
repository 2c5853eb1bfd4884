"""Energies: pure functions of Jacobians, metrics or points to one value per sample."""

from nsm.energies.constraints import (
    boundary,
    boundary_disc,
    boundary_square,
    injectivity,
    inside,
    landmark,
    outside,
    outside_disc,
    outside_square,
    signed_distance,
    unfold,
)
from nsm.energies.distortion import (
    arap,
    area,
    conformal,
    dirichlet,
    equiareal_conformal,
    mips,
    singular_value_ratio,
    symmetric_arap,
    symmetric_dirichlet,
)
from nsm.energies.metrics import (
    Invariants,
    first_fundamental_form,
    pullback_invariants,
    singular_values,
)
from nsm.energies.overfit import normal, position
from nsm.energies.procrustes import rotation
from nsm.energies.registry import ENERGIES, Blend, Energy, energy

__all__ = [
    "ENERGIES",
    "Blend",
    "Energy",
    "Invariants",
    "area",
    "arap",
    "boundary",
    "boundary_disc",
    "boundary_square",
    "conformal",
    "dirichlet",
    "energy",
    "equiareal_conformal",
    "first_fundamental_form",
    "injectivity",
    "inside",
    "landmark",
    "mips",
    "normal",
    "outside",
    "outside_disc",
    "outside_square",
    "position",
    "pullback_invariants",
    "rotation",
    "signed_distance",
    "singular_value_ratio",
    "singular_values",
    "symmetric_arap",
    "symmetric_dirichlet",
    "unfold",
]
