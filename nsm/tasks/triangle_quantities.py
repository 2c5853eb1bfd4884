"""What a map makes of a mesh's triangles, from its images of their corners, by compiled loops.

For the CPU, where gathering corners and scattering their gradients takes longer than the distortion
itself. Where gradients are to be differentiated again, plain operations make them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nsm.compiled import compiled
from nsm.energies import first_fundamental_form
from nsm.energies.metrics import determinant
from nsm.tensors import suit_compiled


def sides(image: Tensor, faces: Tensor) -> Tensor:
    """The first two sides (F, n, 2) of triangles (F, 3) with images (V, n) of the corners."""
    a, b, c = _corners(image, faces)
    return torch.stack([b - a, c - a], dim=-1)


def forms(image: Tensor, faces: Tensor) -> Tensor:
    """First fundamental forms (F, 2, 2) of the sides; arguments as of :func:`sides`."""
    return _of_corners(image, faces, _FORMS)


def determinants(image: Tensor, faces: Tensor) -> Tensor:
    """Twice the signed areas (F,) of triangles (F, 3) with images (V, 2) of the corners."""
    return _of_corners(image, faces, _DETERMINANTS)


def centres(image: Tensor, faces: Tensor) -> Tensor:
    """The centres (F, n); arguments as of :func:`sides`."""
    return _of_corners(image, faces, _CENTRES)


class _Quantity(NamedTuple):
    """A function of triangles.

    Attributes:
        shape: of its values, from F and n.
        plain: it, by operations on tensors.
        values: fills in its values at images (V, n) and faces (F, 3).
        gradient: adds what gradients by the values are by the images, to the last argument.
    """

    shape: Callable[[int, int], tuple[int, ...]]
    plain: Callable[[Tensor, Tensor], Tensor]
    values: Callable[[np.ndarray, np.ndarray, np.ndarray], None]
    gradient: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], None]


def _of_corners(image: Tensor, faces: Tensor, quantity: _Quantity) -> Tensor:
    if not suit_compiled(image):
        return quantity.plain(image, faces)
    values: Tensor = _OfCorners.apply(image, faces, quantity)
    return values


class _OfCorners(torch.autograd.Function):
    """A quantity of triangles."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, faces: Tensor, quantity: _Quantity) -> Tensor:
        ctx.save_for_backward(image, faces)
        ctx.quantity = quantity
        out = image.new_empty(quantity.shape(len(faces), image.shape[1]))
        quantity.values(_array(image), _array(faces), out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        image, faces = ctx.saved_tensors
        if torch.is_grad_enabled():
            out = ctx.quantity.plain(image, faces)
            (found,) = torch.autograd.grad(out, image, gradient, create_graph=True)
            return found, None, None
        found = torch.zeros_like(image, memory_format=torch.contiguous_format)
        ctx.quantity.gradient(_array(image), _array(faces), _array(gradient), found.numpy())
        return found, None, None


def _corners(image: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The three corners, (F, n) each."""
    # not by image[faces], whose backward pass sorts
    a, b, c = image.index_select(0, faces.t().flatten()).view(3, -1, image.shape[1]).unbind()
    return a, b, c


def _array(x: Tensor) -> np.ndarray:
    array: np.ndarray = x.detach().contiguous().numpy()
    return array


@compiled
def _forms(image: np.ndarray, faces: np.ndarray, out: np.ndarray) -> None:
    """See :class:`_Quantity`, as of the following."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        e = m = g = 0.0
        for k in range(image.shape[1]):
            u, v = image[b, k] - image[a, k], image[c, k] - image[a, k]
            e, m, g = e + u * u, m + u * v, g + v * v
        out[f, 0, 0], out[f, 0, 1], out[f, 1, 0], out[f, 1, 1] = e, m, m, g


@compiled
def _forms_gradient(
    image: np.ndarray, faces: np.ndarray, gradient: np.ndarray, out: np.ndarray
) -> None:
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        e, g = 2 * gradient[f, 0, 0], 2 * gradient[f, 1, 1]
        m = gradient[f, 0, 1] + gradient[f, 1, 0]
        for k in range(image.shape[1]):
            u, v = image[b, k] - image[a, k], image[c, k] - image[a, k]
            by_u, by_v = e * u + m * v, m * u + g * v
            out[a, k] -= by_u + by_v
            out[b, k] += by_u
            out[c, k] += by_v


@compiled
def _determinants(image: np.ndarray, faces: np.ndarray, out: np.ndarray) -> None:
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        u, v = image[b, 0] - image[a, 0], image[b, 1] - image[a, 1]
        x, y = image[c, 0] - image[a, 0], image[c, 1] - image[a, 1]
        out[f] = u * y - x * v


@compiled
def _determinants_gradient(
    image: np.ndarray, faces: np.ndarray, gradient: np.ndarray, out: np.ndarray
) -> None:
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        by = gradient[f]
        u, v = by * (image[b, 0] - image[a, 0]), by * (image[b, 1] - image[a, 1])
        x, y = by * (image[c, 0] - image[a, 0]), by * (image[c, 1] - image[a, 1])
        out[b, 0] += y
        out[b, 1] -= x
        out[c, 0] -= v
        out[c, 1] += u
        out[a, 0] -= y - v
        out[a, 1] -= u - x


@compiled
def _centres(image: np.ndarray, faces: np.ndarray, out: np.ndarray) -> None:
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        for k in range(image.shape[1]):
            out[f, k] = (image[a, k] + image[b, k] + image[c, k]) / 3


@compiled
def _centres_gradient(
    image: np.ndarray, faces: np.ndarray, gradient: np.ndarray, out: np.ndarray
) -> None:
    for f in range(len(faces)):
        for k in range(image.shape[1]):
            by = gradient[f, k] / 3
            for m in range(3):
                out[faces[f, m], k] += by


_FORMS = _Quantity(
    lambda faces, n: (faces, 2, 2),
    lambda image, faces: first_fundamental_form(sides(image, faces)),
    _forms,
    _forms_gradient,
)
_DETERMINANTS = _Quantity(
    lambda faces, n: (faces,),
    lambda image, faces: determinant(sides(image, faces)),
    _determinants,
    _determinants_gradient,
)
_CENTRES = _Quantity(
    lambda faces, n: (faces, n),
    lambda image, faces: torch.stack(_corners(image, faces)).mean(dim=0),
    _centres,
    _centres_gradient,
)
