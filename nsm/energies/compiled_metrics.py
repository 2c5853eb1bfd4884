"""Forms of Jacobians and invariants of pairs of metrics by compiled loops.

For the CPU, where each of some thirty operations on tensors takes longer than the whole of it.
Gradients are written out; where they are to be differentiated again, plain operations make them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsm.compiled import compiled

_Gradients = tuple[Tensor | None, ...]


def _by_plain(
    plain: Callable[..., tuple[Tensor, ...]], inputs: tuple[Tensor, ...], gradients: _Gradients
) -> _Gradients:
    """The gradients by the inputs, differentiable, through plain operations."""
    with torch.enable_grad():
        outputs = plain(*inputs)
    wanted = [x for x in inputs if x.requires_grad]
    found = iter(torch.autograd.grad(outputs, wanted, gradients, create_graph=True))
    return tuple(next(found) if x.requires_grad else None for x in inputs)


def _array(x: Tensor, *shape: int) -> np.ndarray:
    flat: np.ndarray = x.detach().reshape(-1, *shape).contiguous().numpy()
    return flat


class Form(torch.autograd.Function):
    """JᵀJ (..., 2, 2) of J (..., n, 2)."""

    @staticmethod
    def forward(ctx: Any, jacobian: Tensor) -> Tensor:
        ctx.save_for_backward(jacobian)
        out = jacobian.new_empty(*jacobian.shape[:-2], 2, 2)
        _form(_array(jacobian, *jacobian.shape[-2:]), out.view(-1, 2, 2).numpy())
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (jacobian,) = ctx.saved_tensors
        if torch.is_grad_enabled():
            return jacobian @ (gradient + gradient.mT)
        out = torch.empty_like(jacobian, memory_format=torch.contiguous_format)
        shape = jacobian.shape[-2:]
        _form_backward(_array(jacobian, *shape), _array(gradient, 2, 2), _array(out, *shape))
        return out


@compiled
def _form(jacobian: np.ndarray, out: np.ndarray) -> None:
    """(N, n, 2) to (N, 2, 2)."""
    for p in range(len(jacobian)):
        e = f = g = 0.0
        for k in range(jacobian.shape[1]):
            u, v = jacobian[p, k, 0], jacobian[p, k, 1]
            e, f, g = e + u * u, f + u * v, g + v * v
        out[p, 0, 0], out[p, 0, 1], out[p, 1, 0], out[p, 1, 1] = e, f, f, g


@compiled
def _form_backward(jacobian: np.ndarray, gradient: np.ndarray, out: np.ndarray) -> None:
    """J (G + Gᵀ), (N, n, 2), of J (N, n, 2) and G (N, 2, 2)."""
    for p in range(len(jacobian)):
        e, g = 2 * gradient[p, 0, 0], 2 * gradient[p, 1, 1]
        f = gradient[p, 0, 1] + gradient[p, 1, 0]
        for k in range(jacobian.shape[1]):
            u, v = jacobian[p, k, 0], jacobian[p, k, 1]
            out[p, k, 0], out[p, k, 1] = e * u + f * v, f * u + g * v


class PullbackInvariants(torch.autograd.Function):
    """Trace and determinant (...) of A⁻¹B: see :func:`nsm.energies.metrics.pullback_invariants`."""

    @staticmethod
    def forward(
        ctx: Any,
        source: Tensor,
        target: Tensor,
        plain: Callable[..., tuple[Tensor, ...]],
        floor: float,
        limit: float,
    ) -> tuple[Tensor, Tensor]:
        """A and B (..., 2, 2) of one shape.

        Args:
            plain: the same by operations on tensors.
            floor: what A's diagonal gains.
            limit: of each entry of the gradients.
        """
        ctx.save_for_backward(source, target)
        ctx.plain, ctx.floor, ctx.limit = plain, floor, limit
        shape = source.shape[:-2]
        trace = torch.empty(shape, dtype=torch.float64)
        determinant = torch.empty(shape, dtype=torch.float64)
        a, b = _array(source, 2, 2), _array(target, 2, 2)
        eps = torch.finfo(source.dtype).eps
        _invariants(a, b, floor, eps, _array(trace), _array(determinant))
        return trace, determinant

    @staticmethod
    def backward(ctx: Any, by_trace: Tensor, by_determinant: Tensor) -> _Gradients:
        source, target = ctx.saved_tensors
        if torch.is_grad_enabled():
            gradients = _by_plain(ctx.plain, (source, target), (by_trace, by_determinant))
            return (*gradients, None, None, None)
        by_a, by_b = (torch.empty(x.shape, dtype=x.dtype) for x in (source, target))
        _invariants_backward(
            _array(source, 2, 2),
            _array(target, 2, 2),
            ctx.floor,
            torch.finfo(source.dtype).eps,
            _array(by_trace),
            _array(by_determinant),
            ctx.limit,
            _array(by_a, 2, 2),
            _array(by_b, 2, 2),
        )
        return by_a, by_b, None, None, None


@compiled
def _entries(metric: np.ndarray) -> tuple[float, float, float]:
    """Those of the symmetric part, in double precision: squares overflow single precision."""
    b = (np.float64(metric[0, 1]) + np.float64(metric[1, 0])) / 2
    return np.float64(metric[0, 0]), b, np.float64(metric[1, 1])


@compiled
def _held(
    source: np.ndarray, target: np.ndarray, floor: float, eps: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Of A and B (2, 2): A's entries with its floor, its determinant, the least that this is held
    above, and B's entries."""
    a, b, c = _entries(source)
    e, f, g = _entries(target)
    a, c = a + floor, c + floor
    least = eps * max(a + c, 2 * floor) ** 2
    return a, b, c, a * c - b * b, least, e, f, g


@compiled
def _invariants(
    source: np.ndarray,
    target: np.ndarray,
    floor: float,
    eps: float,
    trace: np.ndarray,
    determinant: np.ndarray,
) -> None:
    """Metrics (N, 2, 2) to traces and determinants (N,)."""
    for p in range(len(source)):
        a, b, c, det, least, e, f, g = _held(source[p], target[p], floor, eps)
        det = least if det < least else det
        t, d = (c * e - 2 * b * f + a * g) / det, (e * g - f * f) / det
        t, d = 0.0 if t < 0 else t, 0.0 if d < 0 else d
        trace[p], determinant[p] = t, t * t / 4 if d > t * t / 4 else d


@compiled
def _invariants_backward(
    source: np.ndarray,
    target: np.ndarray,
    floor: float,
    eps: float,
    by_trace: np.ndarray,
    by_determinant: np.ndarray,
    limit: float,
    by_a: np.ndarray,
    by_b: np.ndarray,
) -> None:
    """Gradients (N, 2, 2) by the metrics of one by traces and determinants (N,)."""
    for p in range(len(source)):
        a, b, c, own, least, e, f, g = _held(source[p], target[p], floor, eps)
        det = least if own < least else own
        t, d = (c * e - 2 * b * f + a * g) / det, (e * g - f * f) / det
        # d is held at t²/4; where both are equal, each has half of the gradient
        most = max(t, 0.0) ** 2 / 4
        share = 0.5 if max(d, 0.0) == most else (0.0 if d > most else 1.0)
        by_t = by_trace[p] + (1 - share) * by_determinant[p] * max(t, 0.0) / 2
        by_d = share * by_determinant[p]
        by_t, by_d = 0.0 if t < 0 else by_t / det, 0.0 if d < 0 else by_d / det
        by_det = -(by_t * t + by_d * d)
        of_det, of_width = by_det, 0.0
        if own < least:
            of_det, of_width = 0.0, by_det * 2 * eps * (a + c) if a + c >= 2 * floor else 0.0
        _put(
            by_a[p],
            by_t * g + of_det * c + of_width,
            -2 * f * by_t - 2 * b * of_det,
            by_t * e + of_det * a + of_width,
            limit,
        )
        _put(by_b[p], by_t * c + by_d * g, -2 * b * by_t - 2 * f * by_d, by_t * a + by_d * e, limit)


@compiled
def _put(out: np.ndarray, first: float, mixed: float, second: float, limit: float) -> None:
    """A gradient by the entries of a symmetric matrix, each within the limit, as one (2, 2)."""
    out[0, 0] = min(max(first, -limit), limit)
    out[0, 1] = out[1, 0] = min(max(mixed / 2, -limit), limit)
    out[1, 1] = min(max(second, -limit), limit)
