"""A barrier against folds: the triangles of a mesh that a planar map is nearest to folding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from nsm.energies import injectivity, unfold

_COUNT = 256
# triangles of a look; larger meshes are gone through in turn, or a step would cost by their size
_LOOK = 16_384
_SMALL = 0.3  # share of a determinant where the smooth term begins
_NEWTON_FROM = 0.9  # of a further training
_STEEP = 10.0  # its factor, at most, in medians


class FoldBarrier(nn.Module):
    """Finds the triangles whose images have the least signed area relative to their own.

    Samples of Ω hardly ever meet the few triangles that fold; flips are counted on the mesh, so
    they are looked for there.

    Args:
        uv: (V, 2) vertices of the mesh in Ω.
        faces: (F, 3), counter-clockwise.
        areas: (F,) of each triangle before the map; by default its area in Ω.
        margin: relative signed area under which a triangle is penalised (see
            :func:`nsm.energies.unfold`).
        every: steps between two looks at the triangles.
    """

    uv: Tensor
    faces: Tensor
    area: Tensor
    chosen: Tensor

    def __init__(
        self,
        uv: Tensor,
        faces: Tensor,
        areas: Tensor | None = None,
        margin: float = 0.1,
        every: int = 25,
    ) -> None:
        super().__init__()
        self.margin, self.every = margin, every
        self.register_buffer("uv", uv, persistent=False)
        self.register_buffer("faces", faces, persistent=False)
        double = _double_areas(uv[faces]) if areas is None else 2 * areas
        self.register_buffer("area", double.clamp(min=1e-12), persistent=False)
        self.watch(_COUNT)

    def watch(self, count: int) -> None:
        """Act on so many triangles at once."""
        # in the state, so that resumed training goes on with the same ones
        chosen = torch.arange(min(count, len(self.faces)), device=self.faces.device)
        self.register_buffer("chosen", chosen)
        self._looked: int | None = None

    def forward(self, h: Callable[[Tensor], Tensor], step: int) -> Tensor:
        """Mean ``unfold`` over the weakest triangles under h: a scalar."""
        return self.of_image(h(self.corners(h, step)))

    def corners(self, h: Callable[[Tensor], Tensor], step: int) -> Tensor:
        """Points (3C, 2) of Ω: the corners of the C weakest triangles, one after the other."""
        # optimizers may evaluate the loss of a step several times: it must stay the same
        if step % self.every == 0 and step != self._looked:
            self._looked = step
            with torch.no_grad():
                self._look(h, step // self.every)
        return self.uv[self.faces[self.chosen]].reshape(-1, 2)

    def of_image(self, image: Tensor) -> Tensor:
        """The term, from the image (3C, 2) of :meth:`corners`."""
        relative = _double_areas(image.reshape(-1, 3, 2)) / self.area[self.chosen]
        return unfold(relative, self.margin).mean()

    def _look(self, h: Callable[[Tensor], Tensor], number: int) -> None:
        """Choose among all triangles or, of a large mesh, among a part of them and those chosen."""
        faces, area, index = self.faces, self.area, None
        if len(faces) <= _LOOK:
            image = h(self.uv)
        else:
            looks = -(-len(faces) // _LOOK)
            turn = number % looks  # neighbours together share most of their vertices
            ends = (len(faces) * turn // looks, len(faces) * (turn + 1) // looks)
            part = torch.arange(*ends, device=faces.device)
            index = torch.cat([part, self.chosen]).unique()
            rows, faces = faces[index].unique(return_inverse=True)
            image, area = h(self.uv[rows]), area[index]
        relative = _double_areas(image[faces]) / area
        weakest = relative.topk(len(self.chosen), largest=False).indices
        self.chosen = weakest if index is None else index[weakest]

    def flipped_percent(self, h: Callable[[Tensor], Tensor]) -> Tensor:
        """Share of all the mesh's triangles whose image under h has no positive area."""
        return 100 * (_double_areas(h(self.uv)[self.faces]) <= 0).double().mean()


def _double_areas(corners: Tensor) -> Tensor:
    """Twice the signed areas (F,) of triangles (F, 3, 2)."""
    a, b, c = corners.unbind(dim=1)
    u, v = b - a, c - a
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


class Folds:
    """How much h folds at points: G of METHOD, or a smooth term in its place.

    The smooth one takes the determinant relative to what it was at the beginning of the step, and
    begins before h folds, so that a line search is not stopped by a single point: a step may take a
    determinant to a third for nothing. Where it was negative, or far below the median, the
    term pushes it up.

    Args:
        kind: exponential, or smooth.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._held: tuple[int, Tensor] | None = None

    def __call__(self, determinant: Tensor, step: int, smooth: bool = False) -> Tensor:
        """Determinants (...) of J_h, or of triangles relative to their own, to (...).

        Args:
            determinant: of h.
            step: of the training; what is smooth holds the first values of each.
            smooth: whatever the kind is.
        """
        if self.kind == "exponential" and not smooth:
            return injectivity(determinant)
        if self._held is None or self._held[0] != step or self._held[1].shape != determinant.shape:
            scale = 1 / determinant.detach().double().abs().clamp(min=1e-12)
            self._held = step, scale.clamp(max=_STEEP * scale.median())
        return unfold(determinant * self._held[1].to(determinant), _SMALL)

    def __getstate__(self) -> dict[str, object]:
        return {"kind": self.kind, "_held": None}


Weights = TypeVar("Weights")


def stronger(weights: Weights) -> Weights:
    """Loss weights for a further training: λ_tri is ten times as large, and not zero."""
    triangles = max(10 * weights.triangles, 100.0)  # type: ignore[attr-defined]
    return replace(weights, triangles=triangles)  # type: ignore[type-var]


def further_training(module: Any, steps: int) -> None:
    """Prepare a further training at a tenth of the rates, with four times as many triangles seen.
    Where quasi-Newton steps end a training, the last tenth are such, and bring landmarks back;
    these are at triangles where the training's were.
    """
    for part in module.modules():
        if isinstance(part, FoldBarrier):
            part.watch(4 * part.chosen.shape[-1])
    optimizer = module.hparams["optimizer"]
    adam_first = "newton_from" in optimizer
    if adam_first:
        optimizer["newton_from"] = _NEWTON_FROM
    if module.quadrature is not None:
        module.triangles_from = _NEWTON_FROM * steps if adam_first else 0.0
    for rate in ("lr", "encoding_lr"):
        if optimizer.get(rate) is not None:
            optimizer[rate] *= 0.1
    scheduler = module.hparams["scheduler"]
    if "warmup" in scheduler:
        scheduler["warmup"] = min(scheduler["warmup"], steps // 10)
    module.hparams["max_steps"] = steps
