"""Artefacts of version 1, as version 2 has them.

Version 1 named activations and encodings by short names, and a planar map by the domain that it
keeps to. Version 2 stores settings with ``_target_``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsm.migration import migrated, old_target
from nsm.surfaces.cutting import first_copies

_PLANAR = {None: "PlanarMap", "disc": "DiscMap", "square": "SquareMap"}
# parts of a tensor's name, and settings of a network; the names after these are version 1's too
_PARTS = {"readout": "linear_skip", "twins": "seam_pairs"}
_SETTINGS = {"initialisation": "initialization", "readout": "linear_skip"}
_MOST_VERTICES = 200_000_000  # of a mesh file


def from_version_1(
    tensors: dict[str, Tensor], metadata: dict[str, Any]
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and metadata of an artefact of version 1 as version 2 stores them.

    Raises:
        Exception: one of :data:`nsm.results.files.DAMAGE`, for an artefact that is damaged.
    """
    tensors = {
        ".".join(_PARTS.get(part, part) for part in name.split(".")): tensor
        for name, tensor in tensors.items()
    }
    if "surface.source_vertex" in tensors and "surface.cut_vertex" not in tensors:
        source = tensors["surface.source_vertex"].numpy()  # there were no merged vertices
        if not 0 <= source.max() < _MOST_VERTICES:  # an entry is made for each of them
            raise ValueError("no mesh file has that many vertices")
        copies = first_copies(source.astype(np.int64), int(source.max()) + 1)
        tensors["surface.cut_vertex"] = torch.from_numpy(copies)
    config = metadata.get("config")
    if isinstance(config, dict) and "task" in config:
        metadata = {**metadata, "config": migrated(config)}
    return tensors, {**metadata, "map": _map(metadata["map"])}


def _map(old: dict[str, Any]) -> dict[str, Any]:
    """The settings of a map."""
    if "name" in old:  # an analytic surface
        return old
    if "onto" in old:
        network = {key: value for key, value in old.items() if key != "onto"}
        return {"_target_": f"nsm.maps.{_PLANAR[old['onto']]}", "network": _map(network)}
    network = {_SETTINGS.get(key, key): value for key, value in old.items()}
    for part, default in (("activation", "softplus"), ("encoding", "identity")):
        named = dict(old.get(part) or {"name": default})
        name = named.pop("name")
        network[part] = {"_target_": old_target(part, name), **named}
    return {"_target_": "nsm.maps.NeuralMap", **network}
