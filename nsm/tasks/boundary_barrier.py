"""A barrier that keeps the image of a free boundary from meeting itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from nsm.surfaces.predicates import orientation
from nsm.surfaces.topology import boundary_loops
from nsm.tasks.curvature import Curvature

_NEAR = 0.25  # of the shorter of two sides: nearer ones are pushed apart
_LEAST = 1e-3  # of that distance; below it the barrier grows no more
# loss of a crossing that was not there when the step began: a line search turns back
_CROSSED = 1e4


class _Pairs(NamedTuple):
    """Vertices and sides of the boundary that are near to each other.

    Attributes:
        vertex: (M,) numbers of vertices.
        tail, head: (M,) those of the sides' ends.
        reach: (M,) distance from which the barrier acts.
    """

    vertex: Tensor
    tail: Tensor
    head: Tensor
    reach: Tensor


class _Sides(NamedTuple):
    """The sides of the boundary's image: both ends (P, 2), lengths (P,), and their middles."""

    tail: np.ndarray
    head: np.ndarray
    length: np.ndarray
    tree: cKDTree


class _Begun(NamedTuple):
    """Of the image with which a step of the training began.

    Attributes:
        step: its number.
        reach: (2, P) a quarter of the shorter side of each vertex, and of each side.
        crossings: pairs of sides that crossed.
    """

    step: int
    reach: np.ndarray
    crossings: int


class BoundaryBarrier(nn.Module):
    """Σ max(0, ε/d − 1)² over vertices and sides of the boundary, by the number of vertices (Smith
    and Schaefer, 2015, "Bijective parameterization with free boundaries", Eq. 5).

    d is the distance of a vertex from a side that it does not end, in the image; ε is a quarter of
    the shorter one of the side and the vertex's own sides, as they are when a step begins. A map
    whose triangles do not flip and whose boundary does not meet itself is injective. Where the
    boundary crosses itself more often than when the step began, a large number is added.

    Args:
        uv: (V, 2) vertices of the mesh in Ω.
        faces: (F, 3), counter-clockwise.
    """

    uv: Tensor

    def __init__(self, uv: Tensor, faces: Tensor) -> None:
        super().__init__()
        loops = boundary_loops(faces.numpy())
        self.register_buffer("uv", uv[torch.from_numpy(np.concatenate(loops))], persistent=False)
        ends = np.cumsum([len(loop) for loop in loops])
        numbers = np.arange(ends[-1])
        self._head = numbers + 1  # of the side that begins at each vertex
        self._head[ends - 1] = ends - [len(loop) for loop in loops]
        self._begun: _Begun | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_begun": None}

    def forward(self, h: Callable[[Tensor], Tensor], step: int) -> Tensor:
        """The term under h in a step of the training: a scalar."""
        image = h(self.uv)
        tail = _array(image)
        if not np.isfinite(tail).all():  # a step too far, which the loss then says
            return image.sum() * torch.nan
        sides = self._sides(tail)
        begun = self._at_start(sides, step)
        new = max(0, self._crossings(sides) - begun.crossings)
        near = self._near(sides, begun.reach, image)
        return _barrier(image, near)[0].sum() / len(image) + _CROSSED * new

    def curvature(self, h: Any, step: int) -> Curvature:
        """The second derivatives of the term by the distances, seen by each vertex apart."""
        with torch.no_grad():
            image = h(self.uv).double()
            sides = self._sides(_array(image))
            pairs = self._near(sides, self._at_start(sides, step).reach, image)
            _, second, normal, share = _barrier(image, pairs)
            each = second[:, None, None] / len(image) * normal[:, :, None] * normal[:, None, :]
            hessians = image.new_zeros(len(image), 2, 2)
            hessians.index_add_(0, pairs.vertex, each)
            hessians.index_add_(0, pairs.tail, (1 - share).square()[:, None, None] * each)
            hessians.index_add_(0, pairs.head, share.square()[:, None, None] * each)
        return Curvature(h, self.uv, hessians)

    def _sides(self, tail: np.ndarray) -> _Sides:
        head = tail[self._head]
        return _Sides(tail, head, np.linalg.norm(head - tail, axis=1), cKDTree(0.5 * (tail + head)))

    def _at_start(self, sides: _Sides, step: int) -> _Begun:
        """What is kept of the image with which a step began."""
        if self._begun is None or self._begun.step != step:
            own = np.minimum(sides.length, sides.length[np.argsort(self._head)])
            reach = _NEAR * np.stack([own, sides.length])
            self._begun = _Begun(step, reach, self._crossings(sides))
        return self._begun

    def _near(self, sides: _Sides, reach: np.ndarray, like: Tensor) -> _Pairs:
        """The pairs on which the barrier may act."""
        around = 0.5 * sides.length.max() + reach.max()
        near = sides.tree.sparse_distance_matrix(cKDTree(sides.tail), around, output_type="ndarray")
        side, vertex = near["i"], near["j"]
        apart = (side != vertex) & (self._head[side] != vertex)
        side, vertex = side[apart], vertex[apart]
        both = np.minimum(reach[0, vertex], reach[1, side])
        found = np.stack([vertex, side, self._head[side]])
        a, b, c = torch.from_numpy(found).to(like.device)
        return _Pairs(a, b, c, torch.from_numpy(both).to(like))

    def _crossings(self, sides: _Sides) -> int:
        """How many pairs of sides cross."""
        i, j = sides.tree.query_pairs(sides.length.max(), output_type="ndarray").T
        apart = (self._head[i] != j) & (self._head[j] != i)
        i, j = i[apart], j[apart]
        a, b, c, d = sides.tail[i], sides.head[i], sides.tail[j], sides.head[j]
        across = orientation(a, b, c) * orientation(a, b, d) <= 0
        back = orientation(c, d, a) * orientation(c, d, b) <= 0
        return int((across & back).sum())


def _array(image: Tensor) -> np.ndarray:
    array: np.ndarray = image.detach().double().cpu().numpy()
    return array


def _barrier(image: Tensor, pairs: _Pairs) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of pairs with images (P, 2) of the vertices: the barrier (M,), its second derivative by the
    distance, the distance's direction (M, 2), and where on the side the nearest point is."""
    a, b, p = image[pairs.tail], image[pairs.head], image[pairs.vertex]
    along = b - a
    share = ((p - a) * along).sum(1) / along.square().sum(1).clamp(min=1e-30)
    share = share.clamp(0, 1)
    off = p - a - share[:, None] * along
    # a root's derivative at zero would not be finite
    distance = off.square().sum(1).clamp(min=1e-30).sqrt()
    d = distance.maximum(_LEAST * pairs.reach)
    ratio = pairs.reach / d
    excess = (ratio - 1).clamp(min=0)
    second = torch.where(excess > 0, (2 * ratio + 4 * excess) * ratio / d.square(), 0.0)
    return excess.square(), second, off / distance[:, None], share
