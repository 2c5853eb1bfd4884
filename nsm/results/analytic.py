"""Analytic surfaces as targets of maps: the closed form, and a mesh of it for the figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from nsm.domains import Domain
from nsm.domains import domain as domain_of
from nsm.domains.orbifold.domain import ClosedDomain
from nsm.domains.surface import as_it_lies
from nsm.errors import NsmError
from nsm.maps import ANALYTIC, ClosedAnalyticSurface, build_analytic
from nsm.results.artifact import NeuralSurface
from nsm.results.metrics import evaluate
from nsm.surfaces.cutting import first_copies


def analytic_surface(config: dict[str, Any], domain: str | Domain) -> NeuralSurface:
    """An analytic surface over Ω, with no training: its map is the closed form.

    Args:
        config: ``{"name": ..., parameters}`` (see :mod:`nsm.maps.analytic` and
            :mod:`nsm.maps.analytic_closed`).
        domain: Ω, which :meth:`~nsm.domains.Domain.mesh` triangulates.

    Raises:
        NsmError: a surface or a parameter that is not known; ``wrong_domain``: a closed surface
            over another domain than its own, or another one over a closed domain.
    """
    domain, psi = domain_of(domain), build_analytic(config).eval()
    if not lies_over(psi, domain):
        fitting = [name for name, kind in ANALYTIC.items() if lies_over(kind, domain)]
        raise NsmError(
            f"{psi.name} does not lie over domain={domain}, which takes {', '.join(fitting)}; or "
            f"take domain={psi.closed_domain or 'disc'}",
            kind="wrong_domain",
            key="domain",
        )
    if not isinstance(psi, ClosedAnalyticSurface) or not isinstance(domain, ClosedDomain):
        uv, faces = domain.mesh()
        return NeuralSurface(as_it_lies(psi.name, evaluate(psi, uv), faces, uv, domain), psi)
    # its cell has the area of Ω, or of two
    lattice = psi.lattice().numpy() * np.sqrt(domain.area * (2 if domain.even else 1))
    uv, faces, origin = domain.closed_mesh(lattice=lattice)
    first = first_copies(origin, origin.max() + 1)  # copies have one point, to the last digit
    points = evaluate(psi, uv[first])[origin]
    surface = as_it_lies(psi.name, points, faces, uv, domain, origin=origin, lattice=lattice)
    return NeuralSurface(surface, psi)


def lies_over(surface: Any, domain: Domain) -> bool:
    """Whether an analytic surface, or a maker of such surfaces, has Ω's topology."""
    own = getattr(surface, "closed_domain", None)  # functions of users have none
    return bool(own is None if domain.has_boundary else own == domain.name)
