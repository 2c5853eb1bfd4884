"""Vertices on R²/Γ moved one by one to where their triangles are least distorted.

The energy is that of :mod:`nsm.domains.orbifold.newton`. Vertices that are no neighbours move at
once; a step that would flip a triangle or not lower the energy is shortened, or not made. Where a
global step is held up by the worst triangle, these steps are not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nsm.domains.orbifold.stars import Stars
from nsm.domains.orbifold.triangles import Triangles

_TRIES, _SHORTER = 4, 0.35


def relax(uv: np.ndarray, lattice: np.ndarray, stars: Stars, seen: np.ndarray) -> None:
    """One Newton step of each of the stars' middles, within uv (V, 2).

    Args:
        uv, lattice: (V, 2) and (2, 2).
        stars, seen: as for :meth:`Stars.rings`.
    """
    forms = stars.forms(stars.rings(seen, uv, lattice))
    here = uv[stars.vertex].T
    with np.errstate(all="ignore"):
        energy, step = stars.newton(forms, here)
    active = np.isfinite(step).all(axis=0)
    if not active.all():
        stars, corners = stars.chosen(active)
        forms, here = forms.take(corners, axis=1), here[:, active]
        energy, step = energy[active], step[:, active]
    for _ in range(_TRIES):
        if here.size == 0:
            return
        trial = here + step
        better = stars.energy(forms, trial) < energy
        if better.all():
            uv[stars.vertex] = trial.T
            return
        uv[stars.vertex[better]] = trial[:, better].T
        left = ~better
        stars, corners = stars.chosen(left)
        forms, here = forms.take(corners, axis=1), here[:, left]
        energy, step = energy[left], _SHORTER * step[:, left]


def colour_classes(
    mesh: Triangles, seen: np.ndarray, held: np.ndarray
) -> Iterator[tuple[Stars, np.ndarray]]:
    """The stars of all vertices that are not held, no two neighbours in one class, and the lifts
    of their rings.

    Args:
        mesh: its triangles.
        seen: (2, 3, 3F) of its lifts, see :func:`nsm.domains.orbifold.stars.seen`.
        held: (V,) mask.
    """
    for stars in mesh.classes:
        stays = held[stars.vertex]
        moving = stars.chosen(~stays)[0] if stays.any() else stars
        if len(moving.vertex):
            yield moving, seen.take(moving.corners, axis=2)
