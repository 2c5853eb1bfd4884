"""The two edges of every energy: into float64 on entry, back to the caller's type on exit.

A determinant of a float32 metric cancels, and a squared ratio of two metrics overflows float32
long before the metrics do. The arithmetic in between is a few numbers per sample, so float64
costs nothing beside the network; it asks for a device that has it (CPU, CUDA; not Apple MPS).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

VALUE_LIMIT = 1e30  # values saturate here: a mean over any batch stays finite in float32
GRADIENT_LIMIT = 1e18  # entrywise; leaves room for the product with the caller's Jacobian


class _Widen(torch.autograd.Function):
    """Cast to float64; on the way back, limit the gradient before it is cast down."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.to(torch.float64, copy=True)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.dtype = inputs[0].dtype

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Tensor:
        limit = min(GRADIENT_LIMIT, torch.finfo(ctx.dtype).max)
        return grad_outputs[0].clamp(-limit, limit).to(ctx.dtype)


def widen(x: Tensor) -> Tensor:
    """``x`` in float64; its gradient is limited entrywise to ±``GRADIENT_LIMIT``."""
    return _Widen.apply(x)


def narrow(value: Tensor, dtype: torch.dtype) -> Tensor:
    """``value`` in ``dtype``, saturated at ``VALUE_LIMIT`` (with zero gradient beyond it)."""
    return value.clamp(max=min(VALUE_LIMIT, torch.finfo(dtype).max)).to(dtype)


def safe_sqrt(x: Tensor, smallest: float) -> Tensor:
    """√x where x > ``smallest``, else zero with zero gradient (√ has none at zero)."""
    positive = x > smallest
    # the inner `where` keeps the unused branch from sending 0 · ∞ = NaN backwards
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)
