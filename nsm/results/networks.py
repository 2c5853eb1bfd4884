"""Networks from stored settings and weights that may be forged."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from nsm.errors import NotRegistered
from nsm.instantiation import check_trusted, named_object
from nsm.maps import (
    ANALYTIC,
    AnalyticSurface,
    LatticeAligned,
    Rotated,
    build_analytic,
    build_stored,
)


def network_of(
    config: Mapping[str, Any], tensors: Mapping[str, Tensor], trust: Iterable[str] = ()
) -> nn.Module:
    """The network of stored settings, with its weights, frozen.

    It takes no more memory than the weights do: before it is made, it is sketched without storage
    and compared with them.

    Args:
        config: settings, as ``config`` of any map.
        tensors: the network's state.
        trust: modules whose classes the settings may name.

    Raises:
        NotTrusted, NsmError: as :func:`nsm.instantiation.check_trusted`.
        NotRegistered: the name of an analytic surface that is not known.
        ValueError, RuntimeError, TypeError, KeyError: settings and weights do not fit together.
    """
    check_trusted(config, trust)
    if "name" in config:
        if config["name"] not in ANALYTIC:
            raise NotRegistered("analytic surface", config["name"], "register_analytic")
        network: nn.Module = build_analytic(dict(config))
    else:
        _check_lengths(config, len(tensors))
        kind = named_object(str(config["_target_"]))
        if not (inspect.isclass(kind) and issubclass(kind, AnalyticSurface)):
            with torch.device("meta"):
                _check_state(build_stored(config, trust).state_dict(), tensors)
        network = build_stored(config, trust)
    _check_state(network.state_dict(), tensors)
    network.load_state_dict(dict(tensors))
    return network.eval().requires_grad_(False)


def placed_map(
    config: Mapping[str, Any], tensors: Mapping[str, Tensor], trust: Iterable[str] = ()
) -> Rotated | LatticeAligned:
    """A map of the domain after a rotation, or an affine map of the lattice, frozen.

    Arguments and errors as :func:`network_of`.
    """
    inner = {
        key.removeprefix("inner."): v for key, v in tensors.items() if key.startswith("inner.")
    }
    network = network_of(config, inner, trust)
    own = {key: v for key, v in tensors.items() if not key.startswith("inner.")}
    if set(own) == {"rotation"}:
        whole: Rotated | LatticeAligned = Rotated(network, own["rotation"])
    elif set(own) == {"matrix", "shift"}:
        whole = LatticeAligned(network, own["matrix"], own["shift"])
    else:
        raise ValueError(f"neither a rotation nor an affine map: {', '.join(own)}"[:200])
    return whole.eval().requires_grad_(False)


def _check_lengths(settings: Any, most: int) -> None:
    """ValueError for more layers or grids than there are tensors: a sketch takes time for each."""
    if isinstance(settings, Mapping):
        if settings.get("depth", 0) > most:
            raise ValueError(f"{settings['depth']} layers, but {most} tensors")
        for value in settings.values():
            _check_lengths(value, most)
    elif isinstance(settings, (list, tuple)) and len(settings) > most:
        raise ValueError(f"a list of {len(settings)} entries, but {most} tensors")


def _check_state(expected: Mapping[str, Tensor], tensors: Mapping[str, Tensor]) -> None:
    if set(expected) != set(tensors):
        raise ValueError(f"other tensors than {', '.join(expected)}"[:200])
    for name, like in expected.items():
        if tensors[name].shape != like.shape or tensors[name].dtype != like.dtype:
            raise ValueError(f"{name} is not {tuple(like.shape)}")
