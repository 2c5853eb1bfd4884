"""Energies of many maps between two layouts, and their gradients, in one compiled pass.

For the CPU: operations on tensors, about a hundred with their gradients, take several times as
long. :meth:`nsm.correspondence.refinement.Batch.energies` has the equations.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsm.compiled import compiled


class Energies(torch.autograd.Function):
    """Mean energies (H,) of maps by their values and derivatives at triangles."""

    @staticmethod
    def forward(
        ctx: Any,
        h: Tensor,
        number: Tensor,
        bilinear: Tensor,
        inverse_scale: Tensor,
        scale: Tensor,
        area: Tensor,
        limits: tuple[float, float, float],
    ) -> Tensor:
        """All in single precision, but for numbers.

        Args:
            h: (2, H, 3, N) both coordinates of the maps, and their derivatives along each
                triangle's frame.
            number: (H,) of each map's target.
            bilinear: (T, n, n, 4, 3) logarithms of the targets' metrics on a periodic grid: the
                factors of 1, u, v and u v in each cell.
            inverse_scale: (H, N) the determinant of each map's affine part over that of the frame.
            scale: (H, N) the determinant of the frame.
            area: (N,) of the triangles.
            limits: ε; the determinant below which it goes on as an exponential; the energy above
                which it counts by its logarithm.
        """
        energies, gradient = h.new_empty(h.shape[1]), h.new_empty(h.shape)
        _energies(
            h.detach().contiguous().numpy(),
            number.numpy(),
            bilinear.numpy(),
            inverse_scale.numpy(),
            scale.numpy(),
            area.numpy(),
            limits,
            energies.numpy(),
            gradient.numpy(),
        )
        ctx.save_for_backward(gradient)
        return energies

    @staticmethod
    def backward(ctx: Any, by_energy: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return (gradient * by_energy[:, None, None], *[None] * 6)


@compiled
def _read(cell: np.ndarray, entry: int, u: float, v: float) -> tuple[float, float, float]:
    """A cell's (4, 3) bilinear function at (u, v), and both derivatives."""
    one, by_u, by_v, by_uv = cell[0, entry], cell[1, entry], cell[2, entry], cell[3, entry]
    return one + u * by_u + v * (by_v + u * by_uv), by_u + v * by_uv, by_v + u * by_uv


@compiled
def _energies(
    h: np.ndarray,
    number: np.ndarray,
    bilinear: np.ndarray,
    inverse_scale: np.ndarray,
    scale: np.ndarray,
    area: np.ndarray,
    limits: tuple[float, float, float],
    energies: np.ndarray,
    gradient: np.ndarray,
) -> None:
    """Fill in energies (H,) and their gradients by h."""
    n, (eps, low, cap) = bilinear.shape[1], limits
    for k in range(h.shape[1]):
        total = 0.0
        for f in range(h.shape[3]):
            # in double precision: products of small numbers are subtracted
            u, a, b = 0.5 * h[0, k, 0, f], np.float64(h[0, k, 1, f]), np.float64(h[0, k, 2, f])
            v, c, d = 0.5 * h[1, k, 0, f], np.float64(h[1, k, 1, f]), np.float64(h[1, k, 2, f])
            u, v = n * (u - math.floor(u)), n * (v - math.floor(v))
            i, j = min(int(u), n - 1), min(int(v), n - 1)
            u, v = u - i, v - j
            cell = bilinear[number[k], i, j]
            m, m_u, m_v = _read(cell, 0, u, v)
            p, p_u, p_v = _read(cell, 1, u, v)
            q, q_u, q_v = _read(cell, 2, u, v)
            # the exponential of m I + ((p, q), (q, -p)): even I + odd ((p, q), (q, -p))
            r = math.sqrt(p * p + q * q + 1e-12)
            size, grown, by_r = math.exp(m), math.exp(r), 1 / r
            shrunk = 1 / grown
            even = 0.5 * size * (grown + shrunk)
            odd = 0.5 * size * (grown - shrunk) * by_r
            plus, minus = a * a + b * b + c * c + d * d, a * a + b * b - c * c - d * d
            mixed = a * c + b * d
            along = p * minus + 2 * q * mixed
            trace = even * plus + odd * along
            own = (a * d - b * c) * inverse_scale[k, f]
            held, slope = own, 1.0
            if not own > low:
                held = low * math.exp(min(own / low - 1, 0.0))
                slope = held / low
            root = held * size * scale[k, f]
            det = root * root
            under = 1 / (det + eps * trace + eps * eps)
            over = (trace + 2 * eps) * under
            energy = trace + over
            share = np.float64(area[f])
            if energy > cap:
                total += share * cap * (1 + math.log(energy / cap))
                share *= cap / energy
            else:
                total += share * energy
            by_trace = share * (1 + under - eps * over * under)
            by_det = -share * over * under
            by_own = by_det * 2 * root * size * scale[k, f] * slope * inverse_scale[k, f]
            of_r = by_trace * (odd * plus + (even - odd) * by_r * by_r * along)
            of_m = by_trace * trace + by_det * 2 * det
            of_p = by_trace * odd * minus + of_r * p
            of_q = 2 * by_trace * odd * mixed + of_r * q
            gradient[0, k, 0, f] = 0.5 * n * (of_m * m_u + of_p * p_u + of_q * q_u)
            gradient[1, k, 0, f] = 0.5 * n * (of_m * m_v + of_p * p_v + of_q * q_v)
            first, second, both = even + odd * p, even - odd * p, odd * q
            gradient[0, k, 1, f] = 2 * by_trace * (first * a + both * c) + by_own * d
            gradient[0, k, 2, f] = 2 * by_trace * (first * b + both * d) - by_own * c
            gradient[1, k, 1, f] = 2 * by_trace * (second * c + both * a) - by_own * b
            gradient[1, k, 2, f] = 2 * by_trace * (second * d + both * b) + by_own * a
        energies[k] = total
