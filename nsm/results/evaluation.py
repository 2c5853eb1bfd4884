"""Networks at arrays of points, in chunks that fit into memory."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import numpy as np
import torch
from torch import nn

_CHUNK = 16_384


def evaluate(phi: nn.Module, uv: np.ndarray) -> np.ndarray:
    """φ at points (N, 2) of Ω, as float64 (N, 3)."""
    with torch.no_grad():
        return torch.cat([phi(chunk) for chunk in _chunks(phi, uv)]).double().cpu().numpy()


def evaluate_double(h: nn.Module, uv: np.ndarray) -> np.ndarray:
    """A map h of the plane at points (N, 2), as float64 (N, 2), computed in double precision.

    A thin triangle's corners lie nearer to a line than single precision tells.
    """
    return evaluate(copy.deepcopy(h).cpu().double(), uv)


def evaluate_jacobian(phi: nn.Module, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """φ (N, 3) and its Jacobian (N, 3, 2) at points (N, 2) of Ω, as float64."""
    with torch.no_grad():
        parts = [phi.value_and_jacobian(chunk) for chunk in _chunks(phi, uv)]  # type: ignore[operator]
        values, jacobians = (torch.cat(part).double().cpu() for part in zip(*parts, strict=True))
    return values.detach().numpy(), jacobians.detach().numpy()


def _chunks(phi: nn.Module, uv: np.ndarray) -> Iterator[torch.Tensor]:
    like = next(phi.parameters(), torch.zeros(0))
    for start in range(0, max(len(uv), 1), _CHUNK):
        yield torch.as_tensor(uv[start : start + _CHUNK], dtype=like.dtype, device=like.device)
