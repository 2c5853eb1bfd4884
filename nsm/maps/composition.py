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

    @classmethod
    def all_of(cls, turned: Sequence[Rotated], inner: nn.Module) -> Rotated:
        """k such maps as one of points (k, N, 2), around a batch of their inner maps."""
        made = cls.__new__(cls)
        nn.Module.__init__(made)
        made.inner = inner
        made.register_buffer("rotation", torch.stack([one.rotation for one in turned]))
        return made

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, n)."""
        return self.inner(x @ self.rotation.mT)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, n) and Jacobians J_inner(R x)·R, (N, n, 2)."""
        value, jacobian = cast(PointMap, self.inner).value_and_jacobian(x @ self.rotation.mT)
        return value, jacobian @ self.rotation.unsqueeze(-3)
