"""The layers of a network as one differentiable operation on values and tangents.

A stack (P, N, d) holds the values of N points and, below them, their P − 1 tangents. A layer is
one matrix product for all of its planes. The backward pass is written by hand: plain autograd
stores several times as much, and runs many small operations for each layer.

Networks of one architecture can be evaluated in one batch: stacks are then (k, P, N, d), weights
(k, d, d') and biases (k, d).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from nsm.maps.activations import Activation

# Entries of a stack that a CPU processes at once: the operations after a matrix product then find
# its result in the cache.
_AT_ONCE = 192 * 1024


class MLPWithTangents(torch.autograd.Function):
    """Hidden layers a_k = act(z_k), z_k = W_k a_{k−1} + b_k + r_k, and an output layer without act.

    r_k is zero but in every second hidden layer (k = 2, 4, ...), where it is a_{k−2} for
    ``skip="post"`` and z_{k−2} for ``skip="pre"``. The backward pass cannot be differentiated
    again. It skips frozen parameters, and what only they would need is not stored.
    """

    @staticmethod
    def forward(
        ctx: Any,
        stack: Tensor,
        activation: Activation,
        skip: str | None,
        record: bool,
        *parameters: Tensor,
    ) -> Tensor:
        """From a stack (P, N, in) to (P, N, out), or from (k, P, N, in) to (k, P, N, out).

        Args:
            record: whether there will be a backward pass.
            parameters: weights (d, d') and biases (d,) of the layers in turn, or (k, d, d') and
                (k, d).
        """
        weights, biases = parameters[::2], parameters[1::2]
        trained = record and any(ctx.needs_input_grad[4:])
        record = record and any(ctx.needs_input_grad)
        out = stack.new_empty(*stack.shape[:-1], weights[-1].shape[-2])
        tape: list[Tensor | None] = []
        for rows in _chunks(stack.shape, weights[0]):
            a = stack[..., rows, :].contiguous()
            if record:
                tape.append(a if trained else None)
            residual: Tensor | None = None
            for k, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
                joins = skip is not None and k % 2 == 0
                a = _linear(a, weight, bias, residual if joins else None)
                if joins and skip == "pre":
                    residual = a.clone()
                kept = activation.jvp_(_planes(a), record)
                if joins and skip == "post":
                    residual = a
                if record:
                    tape += [a if trained or not kept else None, *kept]
            out[..., rows, :] = _linear(a, weights[-1], biases[-1], None)
        ctx.save_for_backward(*parameters, *tape)
        ctx.activation, ctx.skip, ctx.trained, ctx.shape = activation, skip, trained, stack.shape
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        layers = (len(ctx.needs_input_grad) - 4) // 2
        saved = ctx.saved_tensors  # read once: checkpointing recomputes them here
        parameters, tape = saved[: 2 * layers], saved[2 * layers :]
        weights = parameters[::2]
        of_stack = gradient.new_empty(ctx.shape) if ctx.needs_input_grad[0] else None
        of_parameters: list[Tensor | None] = [None] * (2 * layers)
        chunks = _chunks(ctx.shape, weights[0])
        stride = (len(tape) // len(chunks) - 1) // max(1, layers - 1)
        for number, rows in enumerate(chunks):
            first = number * (1 + stride * (layers - 1))
            g = gradient[..., rows, :].contiguous()
            carried: Tensor | None = None  # the gradient that skips two layers
            for k in range(layers - 1, -1, -1):
                at = first + 1 + stride * k
                joins = ctx.skip is not None and k % 2 == 0
                if k < layers - 1:
                    result, kept = tape[at], tape[at + 1 : at + stride]
                    ctx.activation.vjp_(
                        _planes(g), None if result is None else _planes(result), kept
                    )
                    if joins and ctx.skip == "pre" and carried is not None:
                        g.add_(carried)
                    if joins:
                        carried = g
                if ctx.trained:
                    before = tape[at - stride] if k else tape[first]
                    _accumulate(of_parameters, k, g, before)
                if k == 0:
                    if of_stack is not None:
                        of_stack[..., rows, :] = _back(g, weights[0], None)
                elif ctx.skip == "post" and k % 2 == 1 and carried is not None:
                    g = _back(g, weights[k], carried)
                else:
                    g = _back(g, weights[k], None)
        return (of_stack, None, None, None, *of_parameters)


def _planes(stack: Tensor) -> Tensor:
    """A view of a stack with the planes in front: (P, N, d) or (P, k, N, d)."""
    return stack.transpose(0, -3)


def _chunks(shape: torch.Size, weight: Tensor) -> list[slice]:
    """Equal parts of a stack's points; a single one unless on a CPU."""
    count, parts = shape[-2], 1
    if weight.device.type == "cpu":
        entries = math.prod(shape[:-1]) * weight.shape[-2]
        parts = min(max(1, round(entries / _AT_ONCE)), max(1, count))
    ends = [count * k // parts for k in range(parts + 1)]
    return [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]


def _linear(a: Tensor, weight: Tensor, bias: Tensor, residual: Tensor | None) -> Tensor:
    """One matrix product for all planes of a stack; the bias belongs to the values alone."""
    rows, turned = a.flatten(-3, -2), weight.mT
    past = None if residual is None else residual.flatten(-3, -2)
    z = rows @ turned if past is None else _added(past, rows, turned)
    z = z.view(*a.shape[:-1], weight.shape[-2])
    z.select(-3, 0).add_(bias.unsqueeze(-2))
    return z


def _added(to: Tensor, a: Tensor, b: Tensor, out: Tensor | None = None) -> Tensor:
    """to + a b, of matrices or of batches of them; ``out`` may be ``to``."""
    add = torch.addmm if a.dim() == 2 else torch.baddbmm
    return add(to, a, b, out=out)


def _back(g: Tensor, weight: Tensor, carried: Tensor | None) -> Tensor:
    """The gradient by a layer's input, plus what is carried past the layer, in its memory."""
    rows = g.flatten(-3, -2)
    if carried is None:
        return (rows @ weight).view(*g.shape[:-1], weight.shape[-1])
    past = carried.flatten(-3, -2)
    _added(past, rows, weight, out=past)
    return carried


def _accumulate(gradients: list[Tensor | None], k: int, g: Tensor, before: Tensor) -> None:
    """Add a chunk's share to the gradients by weight and bias of layer k."""
    rows, bias = g.flatten(-3, -2), g.select(-3, 0).sum(dim=-2)
    weight = gradients[2 * k]
    if weight is None:
        gradients[2 * k] = rows.mT @ before.flatten(-3, -2)
        gradients[2 * k + 1] = bias
    else:
        _added(weight, rows.mT, before.flatten(-3, -2), out=weight)
        gradients[2 * k + 1].add_(bias)  # type: ignore[union-attr]
