"""Composed maps, with Jacobians by the chain rule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, cast

import torch
from torch import Tensor, nn


class PointMap(Protocol):
    """A map: values, and values with Jacobians."""

    def __call__(self, x: Tensor) -> Tensor: ...

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]: ...


class Composition(nn.Module):
    """x ↦ outer(inner(x)), such as ψ∘h of a map between surfaces (METHOD, surface to surface).

    Args:
        outer: (N, m) to (N, n), with ``value_and_jacobian``.
        inner: (N, 2) to (N, m), with ``value_and_jacobian``.
    """

    def __init__(self, outer: nn.Module, inner: nn.Module) -> None:
        super().__init__()
        self.outer, self.inner = outer, inner

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, n)."""
        return self.outer(self.inner(x))

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, n) and Jacobians J_outer(inner(x))·J_inner(x), (N, n, 2)."""
        middle, inner_jacobian = cast(PointMap, self.inner).value_and_jacobian(x)
        value, outer_jacobian = cast(PointMap, self.outer).value_and_jacobian(middle)
        return value, outer_jacobian @ inner_jacobian


class Placed(nn.Module):
    """x ↦ inner(x) / scale + center: a surface in the units and place of its mesh file.

    The network's values are scaled and moved in double precision where the device has it.

    Args:
        inner: (N, 2) to (N, n), with ``value_and_jacobian``.
        scale, center: of the surface, whose values are (points - center (n,)) * scale.
    """

    scale: Tensor
    center: Tensor

    def __init__(self, inner: nn.Module, scale: float, center: Tensor) -> None:
        super().__init__()
        self.inner = inner
        like = next(inner.parameters(), torch.zeros(0))
        kind = torch.float32 if like.device.type == "mps" else torch.float64
        self.register_buffer("scale", torch.tensor(scale, dtype=kind, device=like.device))
        self.register_buffer("center", center.detach().to(like.device, kind))

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, n), in the type and on the device of x."""
        return self._placed(self.inner(self._fit(x))).to(x)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, n) and Jacobians J_inner(x) / scale, (N, n, 2)."""
        value, jacobian = cast(PointMap, self.inner).value_and_jacobian(self._fit(x))
        return self._placed(value).to(x), (jacobian / self.scale).to(x)

    def _placed(self, value: Tensor) -> Tensor:
        return value / self.scale + self.center.to(value.device)  # closed forms follow x

    def _fit(self, x: Tensor) -> Tensor:
        """x in the type and on the device of the network's weights."""
        weight = next(self.inner.parameters(), None)
        return x if weight is None else x.to(weight)


def _columns_turned(jacobian: Tensor, matrix: Tensor) -> Tensor:
    """J M of Jacobians (..., N, n, 2) and M (..., 2, 2), as one product of all rows."""
    return (jacobian.flatten(-3, -2) @ matrix).view(jacobian.shape)


class Rotated(nn.Module):
    """x ↦ inner(R x): a fixed rotation of the input, found from the landmarks beforehand.

    Args:
        inner: (N, 2) to (N, n), with ``value_and_jacobian``.
        rotation: R (2, 2); kept in the state, not trained.

    Raises:
        ValueError: R is not a rotation (to 1e-4).
    """

    rotation: Tensor

    def __init__(self, inner: nn.Module, rotation: Tensor) -> None:
        super().__init__()
        if rotation.shape != (2, 2):
            raise ValueError(f"a rotation of the plane is (2, 2), not {tuple(rotation.shape)}")
        r = rotation.detach().double().cpu()
        drift = (r.T @ r - torch.eye(2, dtype=r.dtype, device=r.device)).abs().max()
        if not (drift <= 1e-4 and torch.linalg.det(r) > 0):
            raise ValueError(f"not a rotation: {r.tolist()}")
        self.inner = inner
        self.register_buffer("rotation", rotation.detach().clone())

    def around(self, inner: nn.Module) -> Rotated:
        """The same rotation of another map's input."""
        return Rotated(inner, self.rotation)

    @classmethod
    def all_of(cls, turned: Sequence[Rotated], inner: nn.Module) -> Rotated:
        """k such maps as one of points (k, N, 2), around a batch of their inner maps."""
        made = cls.__new__(cls)
        nn.Module.__init__(made)
        made.inner = inner
        made.register_buffer("rotation", torch.stack([one.rotation for one in turned]))
        return made

    def before(self, x: Tensor) -> Tensor:
        """R x: points (..., N, 2) to those where the inner map starts."""
        return x @ self.rotation.mT

    def back(self, x: Tensor) -> Tensor:
        """R⁻¹ x: the inverse of :meth:`before`."""
        return x @ self.rotation

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, n)."""
        return self.inner(self.before(x))

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, n) and Jacobians J_inner(R x)·R, (N, n, 2)."""
        value, jacobian = cast(PointMap, self.inner).value_and_jacobian(self.before(x))
        return value, _columns_turned(jacobian, self.rotation)


class LatticeAligned(nn.Module):
    """x ↦ inner(B x + c) on a closed domain R²/Γ, with B in SL(2, Z) fixed beforehand.

    x ↦ B x + c takes orbits of Γ to orbits. B and c say which cones correspond, and the isotopy
    class of the map.

    Args:
        inner: (N, 2) to (N, n), with ``value_and_jacobian``.
        matrix: B (2, 2), integers with determinant 1.
        shift: c (2,); on an orbifold integers.

    Raises:
        ValueError: B is not of determinant 1, or has other numbers than integers.
    """

    matrix: Tensor
    shift: Tensor

    def __init__(self, inner: nn.Module, matrix: Tensor, shift: Tensor) -> None:
        super().__init__()
        if matrix.shape != (2, 2) or shift.shape != (2,):
            raise ValueError(f"(2, 2) and (2,) wanted, not {matrix.shape} and {shift.shape}")
        (a, b), (c, d) = matrix.tolist()
        if any(e != round(e) for e in (a, b, c, d)) or a * d - b * c != 1:
            raise ValueError(f"not integers with determinant 1: {matrix.tolist()}")
        if not bool(torch.isfinite(shift).all()):
            raise ValueError(f"not finite: {shift.tolist()}")
        self.inner = inner
        self.register_buffer("matrix", matrix.detach().clone())
        self.register_buffer("shift", shift.detach().clone())

    def around(self, inner: nn.Module) -> LatticeAligned:
        """The same affine map of another map's input."""
        return LatticeAligned(inner, self.matrix, self.shift)

    @classmethod
    def all_of(cls, aligned: Sequence[LatticeAligned], inner: nn.Module) -> LatticeAligned:
        """k such maps as one of points (k, N, 2), around a batch of their inner maps."""
        made = cls.__new__(cls)
        nn.Module.__init__(made)
        made.inner = inner
        made.register_buffer("matrix", torch.stack([one.matrix for one in aligned]))
        made.register_buffer("shift", torch.stack([one.shift for one in aligned]))
        return made

    def before(self, x: Tensor) -> Tensor:
        """B x + c: points (..., N, 2) to those where the inner map starts."""
        return x @ self.matrix.mT + self.shift.unsqueeze(-2)

    def back(self, x: Tensor) -> Tensor:
        """B⁻¹ (x - c): the inverse of :meth:`before`."""
        return (x - self.shift.unsqueeze(-2)) @ torch.linalg.inv(self.matrix).round().mT

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, n)."""
        return self.inner(self.before(x))

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, n) and Jacobians J_inner(B x + c)·B, (N, n, 2)."""
        value, jacobian = cast(PointMap, self.inner).value_and_jacobian(self.before(x))
        return value, _columns_turned(jacobian, self.matrix)
