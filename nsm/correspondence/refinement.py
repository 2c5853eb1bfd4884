"""Short trainings of many maps of the orbifold at once: sines, a table of the target, L-BFGS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nsm.correspondence.layouts import Layout, Table

_EPSILON = 0.01  # of the symmetric Dirichlet energy
_CAPPED = 50.0  # energies above it count by their logarithm
_LEAST_DETERMINANT = 0.1  # below it the determinant goes on as an exponential, which is positive
_MEMORY = 8
_FIRST_STEP = 0.05
_DECREASE = 1e-4


@dataclass(frozen=True)
class Sines:
    """Odd displacements of the torus: n(x) = Σ a_k sin(π k·x), k in one half of a square.

    x + n(x) is then a map of the orbifold 2222 to itself that keeps its cones. Amplitudes are
    divided by √(1 + |k|²), so that a gradient step is one in the Sobolev space H¹.

    Attributes:
        waves: (K, 2) k.
        scale: (K,) 1 / √(1 + |k|²).
    """

    waves: np.ndarray
    scale: np.ndarray

    @classmethod
    def up_to(cls, largest: int) -> Sines:
        """With |k₁|, |k₂| ≤ largest, in an order in which fewer come first."""
        line = np.arange(-largest, largest + 1)
        k = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
        k = k[(k[:, 0] > 0) | ((k[:, 0] == 0) & (k[:, 1] > 0))]
        k = k[np.lexsort((k[:, 1], k[:, 0], np.abs(k).max(axis=1)))]
        return cls(k, 1 / np.sqrt(1 + (k**2).sum(axis=1)))

    def basis(self, x: np.ndarray) -> np.ndarray:
        """Values and both derivatives (3, ..., K) at points (..., 2) of Ω."""
        phase = np.pi * x @ self.waves.T
        sine, cosine = np.sin(phase) * self.scale, np.pi * np.cos(phase) * self.scale
        return np.stack([sine, cosine * self.waves[:, 0], cosine * self.waves[:, 1]])


class Anchors(NamedTuple):
    """Points that maps of a batch draw together.

    Attributes:
        points: (H, G, 2) of the source's Ω.
        places: (H, G, 2) of each map's target, in any lift.
        shapes: (H, 2, 2) of each target's plane: distances are those of ``shape @ x``.
        weights: (H, G) of the squared distances, beside the energy.
    """

    points: Tensor
    places: Tensor
    shapes: Tensor
    weights: Tensor


class Batch:
    """Maps h of one source's layout to targets, x ↦ B (x + n(x)) + c, and their energies.

    Args:
        source: the layout.
        tables: of the targets.
        number: (H,) of each map's target among the tables.
        matrices: B (H, 2, 2).
        shifts: c (H, 2).
        largest: of the waves.
        anchors: points that the maps draw together.
    """

    def __init__(
        self,
        source: Layout,
        tables: list[Table],
        number: np.ndarray,
        matrices: np.ndarray,
        shifts: np.ndarray,
        largest: int,
        anchors: Anchors | None = None,
    ) -> None:
        def tensor(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array, dtype=torch.float32)

        self.basis = tensor(Sines.up_to(largest).basis(source.at))
        self.at, self.area = tensor(source.at), tensor(source.area)
        self.inverse = tensor(source.inverse)
        self.inverse_determinant = torch.linalg.det(self.inverse)
        self.log_metric = tensor(np.stack([t.log_metric for t in tables]))
        self.number = torch.as_tensor(number)
        self.matrices, self.shifts = tensor(matrices), tensor(shifts)
        self.anchors = anchors
        if anchors is not None:
            self.anchor_basis = tensor(Sines.up_to(largest).basis(anchors.points.numpy())[0])

    def losses(self, amplitudes: Tensor) -> Tensor:
        """The energies (H,), and what anchors add to them."""
        loss = self.energies(amplitudes)
        if self.anchors is not None:
            loss = loss + (self.anchors.weights * self.gaps(amplitudes, self.anchors)).sum(dim=1)
        return loss

    def gaps(self, amplitudes: Tensor, anchors: Anchors) -> Tensor:
        """Squared distances (H, G) of anchors' images to the nearest lifts of places."""
        basis = self.anchor_basis[:, :, : amplitudes.shape[1]]
        h = anchors.points + torch.einsum("hgk,hkc->hgc", basis, amplitudes)
        image = torch.einsum("hij,hgj->hgi", self.matrices, h) + self.shifts[:, None]
        squared = []
        for sign in (1, -1):
            off = image - sign * anchors.places
            off = off - 2 * torch.round(off.detach() / 2)
            squared.append((torch.einsum("hij,hgj->hgi", anchors.shapes, off) ** 2).sum(dim=-1))
        return torch.minimum(*squared)

    def energies(self, amplitudes: Tensor) -> Tensor:
        """Mean symmetric Dirichlet energy (H,) of maps with amplitudes (H, K, 2)."""
        stack = torch.einsum("dnk,hkc->dhnc", self.basis[:, :, : amplitudes.shape[1]], amplitudes)
        j = stack[1:].permute(1, 2, 3, 0) + torch.eye(2)  # (H, N, 2, 2): component, direction
        h = self.at + stack[0]
        image = torch.einsum("hij,hnj->hni", self.matrices, h) + self.shifts[:, None]
        metric = _exponential(self._interpolated(self.log_metric, image))
        whole = torch.einsum("hij,hnjk->hnik", self.matrices, j)
        pulled = whole.mT @ metric @ whole
        trace = torch.einsum("nij,hnij->hn", self.inverse, pulled)
        det = j[..., 0, 0] * j[..., 1, 1] - j[..., 0, 1] * j[..., 1, 0]
        low = _LEAST_DETERMINANT
        det = torch.where(det > low, det, low * torch.exp((det / low - 1).clamp(max=0.0)))
        det = det**2 * torch.linalg.det(metric) * self.inverse_determinant
        energy = trace + (trace + 2 * _EPSILON) / (det + _EPSILON * trace + _EPSILON**2)
        large = energy > _CAPPED
        energy = torch.where(large, _CAPPED * (1 + torch.log(energy / _CAPPED)), energy)
        return energy @ self.area

    def _interpolated(self, grid: Tensor, points: Tensor) -> Tensor:
        """Values (H, N, 3) of tables (T, C, C, 3) at points (H, N, 2), bilinear."""
        n = grid.shape[1]
        t = 0.5 * n * points
        cell = torch.floor(t.detach())
        f = (t - cell)[..., None, :]
        i, j = torch.remainder(cell.long(), n).unbind(dim=-1)
        k, m = (i + 1) % n, (j + 1) % n
        number = self.number[:, None]
        u, v = f[..., 0], f[..., 1]
        near = (1 - v) * grid[number, i, j] + v * grid[number, i, m]
        far = (1 - v) * grid[number, k, j] + v * grid[number, k, m]
        return (1 - u) * near + u * far


def refined(batch: Batch, amplitudes: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Lower the losses of all maps of a batch by L-BFGS, each with its own step lengths.

    Returns:
        the amplitudes (H, K, 2), and the losses (H,).
    """
    shape = amplitudes.shape

    def evaluated(x: Tensor) -> tuple[Tensor, Tensor]:
        x = x.detach().requires_grad_(True)
        value = batch.losses(x.view(shape))
        (gradient,) = torch.autograd.grad(value.sum(), x)
        return value.detach(), gradient.nan_to_num()

    x = amplitudes.reshape(shape[0], -1)
    value, gradient = evaluated(x)
    moves: list[Tensor] = []
    changes: list[Tensor] = []
    length = torch.ones(len(x))
    direction = _direction(gradient, moves, changes)
    for _ in range(steps):
        trial = x + length[:, None] * direction
        new, slope = evaluated(trial)
        along = (gradient * direction).sum(dim=1)
        good = new <= value + _DECREASE * length * along
        move = torch.where(good[:, None], trial - x, 0.0)
        change = torch.where(good[:, None], slope - gradient, 0.0)
        x = x + move
        value = torch.where(good, new, value)
        gradient = torch.where(good[:, None], slope, gradient)
        moves, changes = [*moves, move][-_MEMORY:], [*changes, change][-_MEMORY:]
        # those that did not go down try a shorter step along the same direction
        fresh = _direction(gradient, moves, changes)
        direction = torch.where(good[:, None], fresh, direction)
        length = torch.where(good, 1.0, 0.35 * length)
    return x.view(shape), value


def _direction(gradient: Tensor, moves: list[Tensor], changes: list[Tensor]) -> Tensor:
    """The two loops of L-BFGS for each row; steepest descent where there is no history."""
    q = gradient.clone()
    products = [(s * y).sum(dim=1) for s, y in zip(moves, changes, strict=True)]
    usable = [p > 1e-10 for p in products]
    factors = []
    for s, y, p, use in reversed(list(zip(moves, changes, products, usable, strict=True))):
        a = torch.where(use, (s * q).sum(dim=1) / p.clamp(min=1e-30), 0.0)
        q = q - a[:, None] * y
        factors.append(a)
    scale = _FIRST_STEP / gradient.norm(dim=1).clamp(min=1e-12)
    for y, p, use in zip(changes, products, usable, strict=True):
        scale = torch.where(use, p / (y**2).sum(dim=1).clamp(min=1e-30), scale)
    q = scale[:, None] * q
    rows = zip(moves, changes, products, usable, reversed(factors), strict=True)
    for s, y, p, use, a in rows:
        b = torch.where(use, (y * q).sum(dim=1) / p.clamp(min=1e-30), a)
        q = q + (a - b)[:, None] * s
    return -q


def _exponential(log: Tensor) -> Tensor:
    """The matrices (..., 2, 2) with the logarithms m I + ((a, b), (b, -a)), given as (m, a, b)."""
    m, a, b = log.unbind(dim=-1)
    r = torch.sqrt(a**2 + b**2 + 1e-12)
    size = torch.exp(m)
    even, odd = size * torch.cosh(r), size * torch.sinh(r) / r
    first = torch.stack([even + odd * a, odd * b], dim=-1)
    return torch.stack([first, torch.stack([odd * b, even - odd * a], dim=-1)], dim=-2)
