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
        self._held: tuple[int, np.ndarray, int] | None = None  # step, reach, crossings

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_held": None}

    def forward(self, h: Callable[[Tensor], Tensor], step: int) -> Tensor:
        """The term under h in a step of the training: a scalar."""
        image = h(self.uv)
        pairs, crossings = self._found(image, step)
        return _barrier(image, pairs)[0].sum() / len(image) + _CROSSED * crossings

    def curvature(self, h: Any, step: int) -> Curvature:
        """The second derivatives of the term by the distances, seen by each vertex apart."""
        with torch.no_grad():
            image = h(self.uv).double()
            pairs, _ = self._found(image, step)
            _, second, normal, share = _barrier(image, pairs)
            each = second[:, None, None] / len(image) * normal[:, :, None] * normal[:, None, :]
            hessians = image.new_zeros(len(image), 2, 2)
            hessians.index_add_(0, pairs.vertex, each)
            hessians.index_add_(0, pairs.tail, (1 - share).square()[:, None, None] * each)
            hessians.index_add_(0, pairs.head, share.square()[:, None, None] * each)
        return Curvature(h, self.uv, hessians)

    def _found(self, image: Tensor, step: int) -> tuple[_Pairs, int]:
        """The pairs on which the barrier may act, and how many crossings are new in this step."""
        tail = image.detach().double().cpu().numpy()
        head = tail[self._head]
        length = np.linalg.norm(head - tail, axis=1)
        tree = cKDTree(0.5 * (tail + head))
        crossings = self._crossings(
            tail, head, tree.query_pairs(length.max(), output_type="ndarray")
        )
        if self._held is None or self._held[0] != step:
            own = np.minimum(length, length[np.argsort(self._head)])  # both sides of a vertex
            self._held = step, _NEAR * np.stack([own, length]), crossings
        reach = self._held[1]
        around = 0.5 * length.max() + reach.max()
        near = tree.sparse_distance_matrix(cKDTree(tail), around, output_type="ndarray")
        side, vertex = near["i"], near["j"]
        apart = (side != vertex) & (self._head[side] != vertex)
        side, vertex = side[apart], vertex[apart]
        both = np.minimum(reach[0, vertex], reach[1, side])
        found = (vertex, side, self._head[side])
        a, b, c = (torch.from_numpy(each).to(image.device) for each in found)
        pairs = _Pairs(a, b, c, torch.from_numpy(both).to(image))
        return pairs, max(0, crossings - self._held[2])

    def _crossings(self, tail: np.ndarray, head: np.ndarray, pairs: np.ndarray) -> int:
        """How many of the pairs (M, 2) of sides cross."""
        i, j = pairs.T
        apart = (self._head[i] != j) & (self._head[j] != i)
        i, j = i[apart], j[apart]
        a, b, c, d = tail[i], head[i], tail[j], head[j]
        across = orientation(a, b, c) * orientation(a, b, d) <= 0
        back = orientation(c, d, a) * orientation(c, d, b) <= 0
        return int((across & back).sum())


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
