"""Points and values as users give them: checked before anything is computed from them."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from nsm.errors import NsmError


def as_points(given: Any, columns: int, what: str) -> np.ndarray:
    """Points (N, columns) as float64.

    Raises:
        NsmError: another shape, what is no real number, NaN or infinity.
    """
    points = as_values(given, what, kinds="fiub").astype(np.float64)
    if points.ndim != 2 or points.shape[1] != columns:
        raise NsmError(f"{what}: give an array (N, {columns}), not {points.shape}")
    return points


def as_values(given: Any, what: str, *, kinds: str = "fiubc") -> np.ndarray:
    """Numbers of any shape, of the kinds of NumPy's dtypes that are taken.

    Raises:
        NsmError: other things than numbers, NaN or infinity.
    """
    try:
        values = np.asarray(given.detach().cpu() if isinstance(given, Tensor) else given)
    except (TypeError, ValueError):  # rows of different lengths
        raise NsmError(f"{what}: not an array of numbers") from None
    if values.dtype.kind not in kinds:
        raise NsmError(f"{what}: not an array of numbers, but of {values.dtype}")
    if values.dtype.kind in "fc" and not np.isfinite(values).all():
        raise NsmError(f"{what}: NaN or infinity among them; leave these out")
    return values


def check_points(given: Tensor, what: str) -> None:
    """NsmError unless a tensor is (N, 2), of floating point.

    Its values are not looked at: the GPU would have to be waited for.
    """
    if given.ndim != 2 or given.shape[1] != 2 or not given.is_floating_point():
        shape = tuple(given.shape)
        raise NsmError(f"{what}: give a tensor (N, 2) of floating point, not {given.dtype} {shape}")
