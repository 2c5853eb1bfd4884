"""Short trainings of many maps of the orbifold at once: sines, a table of the target, L-BFGS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nsm.correspondence.compiled_energies import Energies
from nsm.correspondence.layouts import Layout, Table
from nsm.tensors import suit_compiled

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
    """Maps h of layouts of one shape to targets, x ↦ B (x + n(x)) + c, and their energies.

    Args:
        sources: the layouts.
        count: (S,) how many maps each has; those of the first one come first.
        tables: of the targets.
        number: (H,) of each map's target among the tables.
        matrices: B (H, 2, 2).
        shifts: c (H, 2).
        largest: of the waves.
        anchors: points that the maps draw together.
    """

    def __init__(
        self,
        sources: Sequence[Layout],
        count: Sequence[int],
        tables: list[Table],
        number: np.ndarray,
        matrices: np.ndarray,
        shifts: np.ndarray,
        largest: int,
        anchors: Anchors | None = None,
    ) -> None:
        def tensor(array: np.ndarray) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(array), dtype=torch.float32)

        # derivatives along an orthonormal frame of each triangle, the columns of L in G⁻¹ = L Lᵀ
        frames = [np.linalg.cholesky(source.inverse) for source in sources]
        self.count = list(count)
        self.bases, affine = [], []  # (K, 3N), (2, H', 3, N)
        of_source = np.split(np.arange(len(matrices)), np.cumsum(count)[:-1])
        for source, frame, own in zip(sources, frames, of_source, strict=True):
            value, *along = Sines.up_to(largest).basis(source.at)
            along = np.einsum("nij,ink->jnk", frame, np.stack(along))
            self.bases.append(tensor(np.concatenate([value, *along]).T))
            at = np.einsum("hij,nj->ihn", matrices[own], source.at) + shifts[own].T[:, :, None]
            turned = np.einsum("hij,njk->ihkn", matrices[own], frame)
            affine.append(np.concatenate([at[:, :, None], turned], axis=2))
        self.affine = tensor(np.concatenate(affine, axis=1))  # (2, H, 3, N)
        scale = np.repeat(np.linalg.det(np.stack(frames)), count, axis=0)
        self.scale = tensor(scale)  # (H, N)
        self.inverse_scale = tensor(np.linalg.det(matrices)[:, None] / scale)
        self.area = tensor(sources[0].area)
        self.number = torch.as_tensor(number)
        self.bilinear = tensor(np.stack([_bilinear(t.log_metric) for t in tables]))
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
        moved = (amplitudes @ self.matrices.mT).permute(2, 0, 1)
        waves = moved.split(self.count, dim=1)
        each = [w @ basis[: w.shape[2]] for w, basis in zip(waves, self.bases, strict=True)]
        h = self.affine + torch.cat(each, dim=1).view(self.affine.shape)
        if not suit_compiled(h):
            return self._plain_energies(h)
        limits = _EPSILON, _LEAST_DETERMINANT, _CAPPED
        found: Tensor = Energies.apply(
            h, self.number, self.bilinear, self.inverse_scale, self.scale, self.area, limits
        )
        return found

    def _plain_energies(self, h: Tensor) -> Tensor:
        """The same (H,) from values and derivatives (2, H, 3, N), by operations on tensors."""
        (x, a, b), (y, c, d) = (one.unbind(dim=1) for one in h)
        m, p, q = self._log_metrics(x, y)
        size, even, odd = _exponential(m, p, q)
        first, second = a * a + b * b, c * c + d * d
        trace = even * (first + second) + odd * (p * (first - second) + 2 * q * (a * c + b * d))
        det = (a * d - b * c) * self.inverse_scale
        low = _LEAST_DETERMINANT
        det = torch.where(det > low, det, low * torch.exp((det / low - 1).clamp(max=0.0)))
        det = (det * size * self.scale) ** 2
        energy = trace + (trace + 2 * _EPSILON) / (det + _EPSILON * trace + _EPSILON**2)
        large = energy > _CAPPED
        energy = torch.where(large, _CAPPED * (1 + torch.log(energy / _CAPPED)), energy)
        return energy @ self.area

    def _log_metrics(self, x: Tensor, y: Tensor) -> Tensor:
        """(m, a, b) (3, H, N) of the targets' tables at points (H, N), bilinear."""
        n = self.bilinear.shape[1]
        s, t = 0.5 * n * x, 0.5 * n * y
        i, j = torch.floor(s.detach()), torch.floor(t.detach())
        row, column = torch.remainder(i.long(), n), torch.remainder(j.long(), n)
        cell = n * (n * self.number[:, None] + row) + column
        rows = self.bilinear.view(-1, 12).index_select(0, cell.view(-1))
        one, by_u, by_v, by_uv = rows.T.contiguous().view(4, 3, *x.shape)
        u, v = s - i, t - j
        return one + u * by_u + v * (by_v + u * by_uv)


def _bilinear(grid: np.ndarray) -> np.ndarray:
    """Coefficients (N, N, 4, 3) of 1, u, v and uv for the cells of a periodic grid (N, N, 3)."""
    far, right = np.roll(grid, -1, axis=0), np.roll(grid, -1, axis=1)
    both = np.roll(far, -1, axis=1)
    return np.stack([grid, far - grid, right - grid, both - far - right + grid], axis=2)


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


def _exponential(m: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The exponential of m I + ((a, b), (b, -a)): the root of its determinant, and the factors of I
    and of ((a, b), (b, -a))."""
    r = torch.sqrt(a * a + b * b + 1e-12)
    size = torch.exp(m)
    return size, size * torch.cosh(r), size * torch.sinh(r) / r
