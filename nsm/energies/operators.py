"""Differential geometry of a surface φ: Ω → R³, from its derivatives by forward-mode AD.

Nothing is discretized: second derivatives come from φ itself, so φ must have continuous ones. A
feature grid needs degree 3 (``encoding.degree=3``); one of degree 2 is warned of. An activation
must be smooth: with ReLU every curvature is zero almost everywhere. Give φ and uv in float64 for
curvatures; float32 leaves three or four digits of them.

φ is any map of points (N, 2) to (N, 3) that treats each point alone, such as the ``module()`` of a
neural surface, which gives the units of its file. All operators stay differentiable in uv and in
the weights of φ.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.func import jvp

from nsm.energies.metrics import first_fundamental_form

Map = Callable[[Tensor], Tensor]


class Curvatures(NamedTuple):
    """Curvatures of a surface at N points, each (N,), in 1/length and 1/length².

    ``mean`` is H = (κ₁ + κ₂)/2, negative on a sphere whose normal points outwards, and ``gaussian``
    K = κ₁κ₂. ``smallest`` κ₁ ≤ ``largest`` κ₂ are the principal ones.
    """

    mean: Tensor
    gaussian: Tensor
    smallest: Tensor
    largest: Tensor


def jacobian(phi: Map, uv: Tensor) -> Tensor:
    """J_φ by forward mode.

    Args:
        phi: points (N, 2) to values (N, n).
        uv: (N, 2), points of Ω.

    Returns:
        (N, n, 2), columns ∂φ/∂u and ∂φ/∂v.

    Raises:
        ValueError: uv is not (N, 2), or φ does not give one row per point.
    """
    _check(uv)
    columns = [_along(phi, direction)(uv) for direction in _axes(uv)]
    if columns[0].ndim != 2 or len(columns[0]) != len(uv):
        raise ValueError(f"values are (N, n) at {len(uv)} points, not {tuple(columns[0].shape)}")
    return torch.stack(columns, dim=-1)


def second_derivatives(phi: Map, uv: Tensor) -> Tensor:
    """The second derivatives of φ by forward mode over forward mode.

    Args:
        phi: points (N, 2) to values (N, n).
        uv: (N, 2), points of Ω.

    Returns:
        (N, n, 2, 2), symmetric in the last two axes.

    Raises:
        ValueError: as :func:`jacobian`.
    """
    _check(uv)
    _check_degree(phi)
    first, second = _axes(uv)
    along = _along(phi, first)
    uu, uv_mixed = _along(along, first)(uv), _along(along, second)(uv)
    vv = _along(_along(phi, second), second)(uv)
    rows = [torch.stack([uu, uv_mixed], dim=-1), torch.stack([uv_mixed, vv], dim=-1)]
    return torch.stack(rows, dim=-2)


def normals(phi: Map, uv: Tensor) -> Tensor:
    """Unit normals φ_u × φ_v / |φ_u × φ_v|, (N, 3); zero where J_φ has not full rank.

    Args:
        phi: points (N, 2) to points of space (N, 3).
        uv: (N, 2), points of Ω.

    Raises:
        ValueError: as :func:`jacobian`, or φ does not map to space.
    """
    return torch.nn.functional.normalize(_cross(_in_space(jacobian(phi, uv))), dim=1, eps=1e-30)


def area_element(phi: Map, uv: Tensor) -> Tensor:
    """√det(J_φᵀJ_φ) = |φ_u × φ_v|, (N,): area on the surface per area in Ω.

    Args:
        phi: points (N, 2) to points of space (N, 3).
        uv: (N, 2), points of Ω.

    Raises:
        ValueError: as :func:`normals`.
    """
    return _cross(_in_space(jacobian(phi, uv))).norm(dim=1)


def second_fundamental_form(phi: Map, uv: Tensor) -> Tensor:
    """II_ij = ⟨∂_i∂_j φ, n⟩, (N, 2, 2), with the normals n of :func:`normals`.

    Args:
        phi: points (N, 2) to points of space (N, 3).
        uv: (N, 2), points of Ω.

    Raises:
        ValueError: as :func:`normals`.
    """
    return torch.einsum("ncij,nc->nij", second_derivatives(phi, uv), normals(phi, uv))


def curvatures(phi: Map, uv: Tensor) -> Curvatures:
    """Mean, Gaussian and principal curvatures, from the shape operator I⁻¹II.

    Args:
        phi: points (N, 2) to points of space (N, 3).
        uv: (N, 2), points of Ω where J_φ has full rank; elsewhere the values are not finite.

    Raises:
        ValueError: as :func:`normals`.
    """
    J = _in_space(jacobian(phi, uv))
    first = first_fundamental_form(J)
    n = torch.nn.functional.normalize(_cross(J), dim=1, eps=1e-30)
    second = torch.einsum("ncij,nc->nij", second_derivatives(phi, uv), n)
    E, F, G = first[:, 0, 0], first[:, 0, 1], first[:, 1, 1]
    L, M, N = second[:, 0, 0], second[:, 0, 1], second[:, 1, 1]
    det = E * G - F * F
    mean = (E * N - 2 * F * M + G * L) / (2 * det)
    gaussian = (L * N - M * M) / det
    # H² ≥ K; at umbilics rounding takes the root of a negative number, and its slope is infinite
    spread = (mean**2 - gaussian).clamp(min=0)
    root = torch.where(spread > 0, spread, 1.0).sqrt() * (spread > 0)
    return Curvatures(mean, gaussian, mean - root, mean + root)


def surface_gradient(phi: Map, f: Map, uv: Tensor) -> Tensor:
    """∇f on the surface, the tangent vectors J_φ I⁻¹ ∇_Ω f, (N, 3).

    Args:
        phi: points (N, 2) to points of space (N, 3).
        f: a function on Ω, points (N, 2) to values (N,).
        uv: (N, 2), points of Ω.

    Raises:
        ValueError: as :func:`normals`, or f does not give one value per point.
    """
    J = _in_space(jacobian(phi, uv))
    slope = jacobian(_one_column(f), uv)[:, 0]
    raised = torch.linalg.solve(first_fundamental_form(J), slope)
    return torch.einsum("ncj,nj->nc", J, raised)


def laplace_beltrami(phi: Map, f: Map, uv: Tensor) -> Tensor:
    """Δf = div ∇f = (1/√g) ∂_i(√g g^ij ∂_j f), (N,), g = J_φᵀJ_φ; zero or negative at maxima.

    Args:
        phi: points (N, 2) to points of space (N, 3).
        f: a function on Ω, points (N, 2) to values (N,), with second derivatives.
        uv: (N, 2), points of Ω.

    Raises:
        ValueError: as :func:`surface_gradient`.
    """
    _check(uv)
    _check_degree(phi)

    def flux(x: Tensor) -> Tensor:
        metric = first_fundamental_form(_in_space(jacobian(phi, x)))
        slope = jacobian(_one_column(f), x)[:, 0]
        E, F, G = metric[:, 0, 0], metric[:, 0, 1], metric[:, 1, 1]
        element = (E * G - F * F).sqrt()
        u = (G * slope[:, 0] - F * slope[:, 1]) / element
        v = (E * slope[:, 1] - F * slope[:, 0]) / element
        return torch.stack([u, v, element], dim=1)

    change = jacobian(flux, uv)
    return (change[:, 0, 0] + change[:, 1, 1]) / flux(uv)[:, 2]


def _check(uv: Tensor) -> None:
    if uv.ndim != 2 or uv.shape[1] != 2 or not uv.is_floating_point():
        raise ValueError(f"points of Ω are (N, 2) floats, not {tuple(uv.shape)} of {uv.dtype}")


def _check_degree(phi: Map) -> None:
    """Warn of a feature grid whose second derivatives jump from cell to cell."""
    network = getattr(phi, "map", phi)  # a neural surface's
    parts = network.modules() if isinstance(network, nn.Module) else ()
    if any(getattr(part, "degree", None) == 2 for part in parts):
        warnings.warn(
            "second derivatives of a grid of degree 2 jump from cell to cell; train φ with "
            "encoding.degree=3, on a domain with boundary",
            stacklevel=3,
        )


def _axes(uv: Tensor) -> tuple[Tensor, Tensor]:
    return torch.eye(2, dtype=uv.dtype, device=uv.device).unbind()  # type: ignore[return-value]


def _along(f: Map, direction: Tensor) -> Map:
    """The derivative of f in one direction (2,) at each point."""

    def derivative(x: Tensor) -> Tensor:
        change: Tensor = jvp(f, (x,), (direction.expand_as(x).clone(),))[1]
        return change

    return derivative


def _in_space(J: Tensor) -> Tensor:
    if J.shape[1] != 3:
        raise ValueError(f"a surface is a map to space, not to R^{J.shape[1]}")
    return J


def _one_column(f: Map) -> Map:
    def column(x: Tensor) -> Tensor:
        values = f(x)
        if values.shape != (len(x),):
            raise ValueError(
                f"a function has one value at each of {len(x)} points, not {tuple(values.shape)}"
            )
        return values[:, None]

    return column


def _cross(J: Tensor) -> Tensor:
    return torch.linalg.cross(J[:, :, 0], J[:, :, 1])
