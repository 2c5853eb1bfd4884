"""Maps between surfaces, read from their files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from nsm.results.artifact import load_surface
from nsm.results.certificate import Correction
from nsm.results.files import DAMAGE, damaged, read_pair
from nsm.results.networks import placed_map
from nsm.results.surface_map import FORMAT, STEM, SurfaceMap


def load_surface_map(folder: str | Path, trust: Iterable[str] = ()) -> SurfaceMap:
    """Read what :meth:`SurfaceMap.save` wrote.

    Args, Raises:
        as for :func:`nsm.results.load_surface`.
    """
    place = Path(folder)
    tensors, metadata = read_pair(place / STEM, FORMAT)
    source, target = (load_surface(place / end, trust) for end in ("source", "target"))
    try:
        correction = Correction.taken(tensors, len(source.surface.vertices))
        h = placed_map(metadata["map"], tensors, trust)
        landmarks = np.array(metadata["landmarks"], dtype=np.int64).reshape(-1, 2)
        metrics, config = dict(metadata["metrics"]), dict(metadata["config"])
    except DAMAGE as error:
        raise damaged(place / STEM, error) from error
    return SurfaceMap(source, target, h, landmarks, metrics, config, correction)
