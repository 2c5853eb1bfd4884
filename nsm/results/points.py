"""Checks of the points and values that users give."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from nsm.errors import NsmError


def as_points(given: Any, columns: int, name: str) -> np.ndarray:
    """Points (N, columns) as float64.

    Raises:
        NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``, with the name as key.
    """
    points = as_values(given, name, kinds="fiub").astype(np.float64)
    if points.ndim != 2 or points.shape[1] != columns:
        message = f"{name}: give an array (N, {columns}), not {points.shape}"
        raise NsmError(message, kind="wrong_shape", key=name)
    return points


def as_values(given: Any, name: str, *, kinds: str = "fiubc") -> np.ndarray:
    """Numbers of any shape.

    Args:
        given: an array, a tensor or nested lists.
        name: of the argument, in messages.
        kinds: the kinds of NumPy's dtypes that are accepted.

    Raises:
        NsmError: ``wrong_type`` or ``not_finite``, with the name as key.
    """
    try:
        values = np.asarray(given.detach().cpu() if isinstance(given, Tensor) else given)
    except (TypeError, ValueError):  # rows of different lengths
        raise NsmError(f"{name}: not an array of numbers", kind="wrong_type", key=name) from None
    if values.dtype.kind not in kinds:
        message = f"{name}: not an array of numbers, but of {values.dtype}"
        raise NsmError(message, kind="wrong_type", key=name)
    if values.dtype.kind in "fc" and not np.isfinite(values).all():
        raise NsmError(f"{name}: it has NaN or infinity; remove them", kind="not_finite", key=name)
    return values


def check_points(given: Tensor, name: str, *, columns: int = 2) -> None:
    """Refuse a tensor that is not (N, columns) of floating point.

    The values are not looked at, which would wait for the GPU.

    Raises:
        NsmError: ``wrong_shape``, with the name as key.
    """
    if given.ndim != 2 or given.shape[1] != columns or not given.is_floating_point():
        kind = f"{given.dtype} {tuple(given.shape)}"
        message = f"{name}: give a tensor (N, {columns}) of floating point, not {kind}"
        raise NsmError(message, kind="wrong_shape", key=name)
