"""Networks from saved settings and weights that may be forged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from nsm.errors import NotRegistered
from nsm.maps import ACTIVATIONS, BLOCKS, ENCODINGS

Network = TypeVar("Network", bound=nn.Module)


def network_of(
    build: Callable[[dict[str, Any]], Network],
    config: dict[str, Any],
    tensors: Mapping[str, Tensor],
) -> Network:
    """The network that ``build`` makes of ``config``, with the weights ``tensors``.

    It takes no more memory than the weights do: before it is made, it is sketched without storage
    and compared with them.

    Raises:
        NotRegistered: a name that is not known.
        ValueError, RuntimeError, TypeError, KeyError: settings and weights do not fit together.
    """
    _check_known(config)
    encoding = config.get("encoding") or {}
    for count in (config.get("depth", 0), len(encoding.get("resolutions", ()))):
        if count > len(tensors):
            raise ValueError(f"{count} layers or grids, but {len(tensors)} arrays")
    with torch.device("meta"):
        sketch = build(config).state_dict()
    if set(sketch) != set(tensors):
        raise ValueError(f"other arrays than {', '.join(sketch)}"[:200])
    for name, like in sketch.items():
        if tensors[name].shape != like.shape or tensors[name].dtype != like.dtype:
            raise ValueError(f"{name} is not {tuple(like.shape)}")
    network = build(config)
    network.load_state_dict(dict(tensors))
    return network


def _check_known(config: dict[str, Any]) -> None:
    names: dict[str, tuple[Any, Mapping[str, Any]]] = {
        "activation": ((config.get("activation") or {}).get("name"), ACTIVATIONS),
        "encoding": ((config.get("encoding") or {}).get("name"), ENCODINGS),
        "block": (config.get("block"), BLOCKS),
    }
    for kind, (name, known) in names.items():
        if isinstance(name, str) and name not in known:
            raise NotRegistered(kind, name, f"register_{kind}")
