"""A map of surfaces on tensors: differentiable in the points, and in the weights of h.

The map sends a point p of a triangle of the source to its image under the affine map of that
triangle into the target's domain, and on to the point there of the target's mesh. Which triangles
these are is looked up; within them p's image is a differentiable expression. The derivative is that
of the piece, and jumps between pieces.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor, nn

from nsm.domains import Surface
from nsm.domains.caps import located_on_part, off_rims, on_caps
from nsm.results.certificate import Correction
from nsm.results.points import as_points, check_points
from nsm.surfaces.location import Places

if TYPE_CHECKING:
    from nsm.results.surface_map import SurfaceMap

Image = Callable[[np.ndarray | None], Tensor]
_AXES = 3


class SurfaceMapModule(nn.Module):
    """f as a torch module: points (N, 3) of the source to points (N, 3) of the target.

    Points are in the units and place of the mesh files; those off the source are projected to it.
    Its weights are a copy of h's, frozen until ``requires_grad_(True)``. Meshes stay in numpy, and
    points are looked up on the CPU, on whatever device they are.

    Args:
        f: the map, which stays as it is.

    Attributes:
        h: the network of the map, as a module.
    """

    offset: Tensor

    def __init__(self, f: SurfaceMap) -> None:
        super().__init__()
        self._map = f
        self.h = copy.deepcopy(f.map)
        with torch.no_grad():
            own = self._network(None)
            # what a repair, or a closed domain's copies, add to the network's values
            self.register_buffer("offset", torch.as_tensor(f.image_uv).to(own) - own)

    def forward(self, points: Tensor) -> Tensor:
        """Points (N, 3) to their images (N, 3).

        Raises:
            NsmError: ``wrong_shape`` or ``not_finite``.
        """
        return moved(self._map, points, self._image)

    def inverse(self, points: Tensor) -> Tensor:
        """Points (N, 3) of the target to those (N, 3) of the source that f sends there.

        Raises:
            NsmError: as :meth:`forward`.
        """
        return moved(self._map, points, self._image, back=True)

    def value_and_jacobian(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Images (N, 3) and Jacobians (N, 3, 3), whose rows are those of the image.

        The Jacobian takes tangent vectors of the source to those of the target, and the source's
        normal to zero.

        Raises:
            NsmError: as :meth:`forward`.
        """
        return value_and_jacobian(self._map, points, self._image)

    def surface_map(self) -> SurfaceMap:
        """The map of the present weights, frozen, without repair; its figures are not updated."""
        h = copy.deepcopy(self.h).cpu().eval().requires_grad_(False)
        return replace(self._map, map=h, metrics={}, correction=Correction(), vertex_image=None)

    def _image(self, vertices: np.ndarray | None) -> Tensor:
        offset = self.offset if vertices is None else self.offset[torch.from_numpy(vertices)]
        return self._network(vertices) + offset

    def _network(self, vertices: np.ndarray | None) -> Tensor:
        uv = self._map.source.surface.uv
        like = next(self.h.parameters(), torch.zeros(0))
        chosen = torch.as_tensor(uv if vertices is None else uv[vertices]).to(like)
        return cast(Tensor, self.h(chosen)).to(like.device)


class MapSequence(nn.Sequential):
    """Modules of maps one after the other, as ``(g @ f).module()`` makes it."""

    def inverse(self, points: Tensor) -> Tensor:
        """As :meth:`SurfaceMapModule.inverse`: the last map's inverse comes first."""
        for f in reversed(cast(Sequence[SurfaceMapModule], self)):
            points = f.inverse(points)
        return points

    def value_and_jacobian(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """As :meth:`SurfaceMapModule.value_and_jacobian`, by the chain rule."""
        first, *others = cast(Iterable[SurfaceMapModule], self)
        value, jacobian = first.value_and_jacobian(points)
        for f in others:
            value, own = f.value_and_jacobian(value)
            jacobian = own @ jacobian
        return value, jacobian


def fixed_image(f: SurfaceMap) -> Image:
    """Images of vertices as they are stored, without a gradient for the weights."""
    uv = torch.as_tensor(f.image_uv)
    return lambda vertices: uv if vertices is None else uv[torch.from_numpy(vertices)]


def moved(f: SurfaceMap, points: Tensor, image: Image, *, back: bool = False) -> Tensor:
    """Points (N, 3) by f, or by its inverse.

    Args:
        f: the map.
        points: (N, 3) of floating point, in the units of the mesh file.
        image: from vertices (M,) of the source to where h sends them, (M, 2); None: all of them.
        back: by the inverse.

    Returns:
        (N, 3) in the type of the points, on their device; NaN where no point of a source that is a
        part goes.

    Raises:
        NsmError: ``wrong_shape`` or ``not_finite``.
    """
    return _pieces(f, points, image, back)(points)


def planar_moved(f: SurfaceMap, uv: Tensor) -> Tensor:
    """Points (N, 2) of the source's domain to those (N, 2) of the target's.

    Elements of a closed domain's group, on both sides of h, are translations and turns by π: they
    leave its derivative as it is in the lift that has the triangle.

    Raises:
        NsmError: ``wrong_shape`` or ``not_finite``.
    """
    check_points(uv, "points of the domain")
    at, s = uv.detach().cpu().double().numpy(), f.source.surface
    value = f.planar(at)
    corners = s.faces[s.layout.locate(at).face]
    before, after = (
        np.stack([x[corners[:, k]] - x[corners[:, 0]] for k in (1, 2)], axis=2)
        for x in (s.uv, f.image_uv)
    )
    slope = torch.as_tensor(after @ np.linalg.inv(before)).to(uv)
    moved = slope @ (uv - uv.detach())[:, :, None]
    return torch.as_tensor(value).to(uv) + moved[:, :, 0]


def value_and_jacobian(f: SurfaceMap, points: Tensor, image: Image) -> tuple[Tensor, Tensor]:
    """Images (N, 3) and Jacobians (N, 3, 3); arguments and errors as for :func:`moved`."""
    through = _pieces(f, points, image, False)
    columns = [
        torch.func.jvp(through, (points,), (axis.expand_as(points).clone(),))[1]
        for axis in torch.eye(_AXES, dtype=points.dtype, device=points.device)
    ]
    return through(points), torch.stack(columns, dim=-1)


def _pieces(f: SurfaceMap, points: Tensor, image: Image, back: bool) -> Callable[[Tensor], Tensor]:
    """The affine maps of the triangles that points (N, 3) are on, and those that they come to."""
    start, end = (f.target, f.source) if back else (f.source, f.target)
    s, e = start.surface, end.surface

    # Apple's GPUs have no double precision
    kind = torch.float32 if points.device.type == "mps" else torch.float64

    def like(array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=kind, device=points.device)

    name = "points on the target" if back else "points on the source"
    check_points(points, name, columns=_AXES)
    places = located(s, points.detach().cpu().double().numpy(), name)
    corners = s.faces[places.face]
    if back:
        laid_out, reached = like(s.uv[corners]), image(None).to(points.device, kind)
    else:
        used, number = np.unique(corners, return_inverse=True)
        laid_out = image(used).to(points.device, kind)[number.reshape(corners.shape)]
        reached = like(e.uv)
    weights = like(places.weights)
    uv = (weights[:, :, None] * laid_out).sum(dim=1).detach().cpu().double().numpy()
    layout = e.layout
    if back:
        layout = e.domain.layout(reached.detach().cpu().double().numpy(), e.faces)
    found = off_rims(e, layout.locate(uv))
    absent, nan = on_caps(e, found.face), torch.tensor(torch.nan, dtype=kind, device=points.device)
    at, ends = like(found.weights), reached[e.faces[found.face]]
    near = (at[:, :, None] * ends).sum(dim=1).detach()
    begin, finish = like(s.vertices[corners]), like(e.vertices[e.faces[found.face]])

    def through(given: Tensor) -> Tensor:
        p = (given.to(kind) - like(s.center)) * s.scale
        uv = (_barycentric(p, begin, weights)[:, :, None] * laid_out).sum(dim=1)
        inside = _barycentric(e.domain.lift(uv, near), ends, at)
        result = (inside[:, :, None] * finish).sum(dim=1)
        if absent.any():
            result = torch.where(torch.from_numpy(absent)[:, None].to(result.device), nan, result)
        return (result / e.scale + like(e.center)).to(given.dtype)

    return through


def located(surface: Surface, points: np.ndarray, name: str) -> Places:
    """Where points (N, 3), in the units of its file, are on a surface's mesh, not on its caps.

    Raises:
        NsmError: ``wrong_shape``, ``wrong_type`` or ``not_finite``.
    """
    points = as_points(points, 3, name)
    with np.errstate(over="ignore"):  # of points far away
        normalised = (points - surface.center) * surface.scale
    return located_on_part(surface, normalised)


def _barycentric(points: Tensor, corners: Tensor, value: Tensor) -> Tensor:
    """Barycentric coordinates (N, 3) whose values are known, with the derivatives of a formula.

    Args:
        points: (N, d) in the planes of their triangles.
        corners: (N, 3, d).
        value: (N, 3), clipped to the triangles.
    """
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = points - corners[:, 0]
    d11, d12, d22 = (e1 * e1).sum(1), (e1 * e2).sum(1), (e2 * e2).sum(1)
    p1, p2 = (p * e1).sum(1), (p * e2).sum(1)
    determinant = d11 * d22 - d12 * d12
    safe = torch.where(determinant.abs() > 1e-300, determinant, 1.0)
    w1, w2 = (d22 * p1 - d12 * p2) / safe, (d11 * p2 - d12 * p1) / safe
    formula = torch.stack([1 - w1 - w2, w1, w2], dim=1)
    return value + (formula - formula.detach())
