"""Analytic surfaces as targets of maps: the closed form, and a mesh of it for the figures."""

from __future__ import annotations

from typing import Any

from nsm.maps import build_analytic
from nsm.results.artifact import NeuralSurface
from nsm.results.metrics import evaluate
from nsm.surfaces.shapes import grid_mesh, ring_mesh
from nsm.surfaces.surface import as_it_lies

_RINGS, _SIDE = 80, 120


def analytic_surface(config: dict[str, Any], domain: str) -> NeuralSurface:
    """An analytic surface over Ω, with no training: its map is the closed form.

    Args:
        config: ``{"name": ..., parameters}`` (see :mod:`nsm.maps.analytic`).
        domain: ``disc`` or ``square``.

    Raises:
        NsmError: a surface or a parameter that is not known.
    """
    psi = build_analytic(config).eval()
    uv, faces = ring_mesh(_RINGS) if domain == "disc" else grid_mesh(_SIDE)
    surface = as_it_lies(psi.name, evaluate(psi, uv), faces, uv, domain)
    return NeuralSurface(surface, psi)
