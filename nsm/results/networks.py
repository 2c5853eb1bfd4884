"""Networks from stored settings and weights that may be forged."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from nsm.instantiation import REGISTERED, check_trusted, named_object
from nsm.maps import AnalyticSurface, Rotated, build_stored


def network_of(
    config: Mapping[str, Any], tensors: Mapping[str, Tensor], trust: Iterable[str] = ()
) -> nn.Module:
    """The network of stored settings, with its weights, frozen.

    It takes no more memory than the weights do: before it is made, it is sketched without storage
    and compared with them.

    Args:
        config: settings with ``_target_``, as ``config`` of any map.
        tensors: the network's state.
        trust: modules whose classes the settings may name.

    Raises:
        NotTrusted, NsmError: as :func:`nsm.instantiation.check_trusted`.
        ValueError, RuntimeError, TypeError, KeyError: settings and weights do not fit together.
    """
    check_trusted(config, trust)
    _check_lengths(config, len(tensors))
    if not _has_closed_form(str(config["_target_"])):
        with torch.device("meta"):
            _check_state(build_stored(config, trust).state_dict(), tensors)
    network = build_stored(config, trust)
    _check_state(network.state_dict(), tensors)
    network.load_state_dict(dict(tensors))
    return network.eval().requires_grad_(False)


def rotated_map(
    config: Mapping[str, Any], tensors: Mapping[str, Tensor], trust: Iterable[str] = ()
) -> Rotated:
    """A map of the domain after a rotation, frozen; arguments and errors as :func:`network_of`."""
    inner = {key.removeprefix("inner."): v for key, v in tensors.items() if key != "rotation"}
    turned = Rotated(network_of(config, inner, trust), tensors["rotation"])
    return turned.eval().requires_grad_(False)


def _has_closed_form(target: str) -> bool:
    """Whether a target computes while it is made, which a sketch cannot: an analytic surface."""
    kind = named_object(target)
    closed = inspect.isclass(kind) and issubclass(kind, AnalyticSurface)
    return closed or target.startswith(f"{REGISTERED}.")


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
