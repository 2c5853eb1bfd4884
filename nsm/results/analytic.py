"""Analytic surfaces as targets of maps: the closed form, and a mesh of it for the figures."""

from __future__ import annotations

from typing import Any

from nsm.domains import Domain
from nsm.domains import domain as domain_of
from nsm.domains.surface import as_it_lies
from nsm.maps import build_analytic
from nsm.results.artifact import NeuralSurface
from nsm.results.metrics import evaluate


def analytic_surface(config: dict[str, Any], domain: str | Domain) -> NeuralSurface:
    """An analytic surface over Ω, with no training: its map is the closed form.

    Args:
        config: ``{"name": ..., parameters}`` (see :mod:`nsm.maps.analytic`).
        domain: Ω, which :meth:`~nsm.domains.Domain.mesh` triangulates.

    Raises:
        NsmError: a surface or a parameter that is not known.
    """
    domain, psi = domain_of(domain), build_analytic(config).eval()
    uv, faces = domain.mesh()
    return NeuralSurface(as_it_lies(psi.name, evaluate(psi, uv), faces, uv, domain), psi)
