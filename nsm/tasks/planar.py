"""The planar map h that a task trains, from plain settings."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import nn

from nsm.errors import NsmError
from nsm.instantiation import named_object, target_of
from nsm.maps import (
    MultilevelSpline,
    NeuralMap,
    PlanarMap,
    PlanarNetwork,
    SplineField,
    StartedMap,
)
from nsm.maps.networks import build_network


def planar_map(
    domain: Any,
    map: dict[str, Any],
    activation: dict[str, Any],
    encoding: dict[str, Any],
    start: nn.Module | None = None,
) -> Any:
    """h: Ω → R², the identity, or another given map, before its training.

    Args:
        domain: h maps it to itself, by construction; None: h is unconstrained.
        map, activation, encoding: settings of h's network.
        start: what an unconstrained h is before its training; None: the identity.

    Raises:
        NsmError: a linear skip that is to be fitted to a surface.
    """
    if map.get("linear_skip") == "fitted":
        raise NsmError(
            "setting map.linear_skip: a planar map has no surface to fit; "
            "take initialization=random",
            kind="unknown_option",
            key="map.linear_skip",
        )
    out_dim, kind = 2, named_object(map.get("_target_", target_of(NeuralMap)))
    if domain is not None:
        out_dim = domain.network_out_dim
        periodic = domain.encoding(encoding, of_map=True)
        if not domain.has_boundary:
            if kind is PlanarNetwork:
                finest = max(4, int(np.max(encoding.get("resolutions", periodic["resolutions"]))))
                return domain.equivariant(MultilevelSpline(2, finest + finest % 2, domain.even))
            if kind is SplineField:
                map = {**map, "periodic": True, "odd": domain.even}
        encoding = periodic
    if kind is PlanarNetwork:
        map = {**map, "_target_": target_of(NeuralMap)}
    network = build_network(map=map, activation=activation, encoding=encoding, out_dim=out_dim)
    if domain is not None:
        return domain.equivariant(network)
    return PlanarMap(network) if start is None else StartedMap(network, start)
