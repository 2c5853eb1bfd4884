"""Planar maps h: Ω → R² that start as the identity."""

from __future__ import annotations

from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from nsm.errors import NsmError
from nsm.instantiation import target_of


class IdentityInitializedMap(nn.Module):
    """A map around a network whose output is zero at the start.

    Args:
        network: (N, 2) to (N, ``network_out_dim``), with ``value_and_jacobian`` and ``config``. Its
            output layer, ``output`` or else the last linear layer, is set to zero.

    Attributes:
        config: settings with ``_target_`` from which :func:`nsm.maps.build_stored` makes it again.

    Raises:
        NsmError: the network has no linear layer at its end, or another number of outputs.
    """

    network: Any
    network_out_dim: ClassVar[int] = 2

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        linear = [m for m in network.modules() if isinstance(m, nn.Linear)]
        last = getattr(network, "output", linear[-1] if linear else None)
        if isinstance(last, nn.Linear):
            nn.init.zeros_(last.weight)
            if last.bias is not None:
                nn.init.zeros_(last.bias)
        with torch.no_grad():
            start = network(next(network.parameters(), torch.zeros(())).new_full((1, 2), 0.25))
        # a sketch without storage has shapes, but no values
        fits = start.shape == (1, self.network_out_dim)
        if not fits or not (start.is_meta or not start.count_nonzero()):
            raise NsmError(
                f"map: its network needs {self.network_out_dim} outputs, and a linear layer at its "
                "end to start at zero",
                kind="unsuitable_network",
                key="map",
            )

    @classmethod
    def around(cls, network: nn.Module) -> Self:
        """The map around a network that is left as it is, or around a batch of networks."""
        made = cls.__new__(cls)
        nn.Module.__init__(made)
        made.network = network
        return made

    @property
    def config(self) -> dict[str, Any]:
        target = target_of(type(self))
        for module in ("planar", "equivariant", "started"):
            target = target.replace(f"nsm.maps.{module}.", "nsm.maps.")
        return {"_target_": target, "network": self.network.config}


class PlanarMap(IdentityInitializedMap):
    """h(x) = x + N(x), unconstrained."""

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return x + self.network(x)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        value, jacobian = self.network.value_and_jacobian(x)
        return x + value, torch.eye(2, dtype=x.dtype, device=x.device) + jacobian


class DiscMap(IdentityInitializedMap):
    """h(x) = R(θ(x))·(x + (1 − ‖x‖²)·N(x)): the circle goes to itself, whatever N and θ are.

    The boundary constraint (METHOD, B) holds by construction, and the image of ∂Ω slides by θ.

    Args:
        network: (N, θ), with three outputs.
    """

    network_out_dim = 3

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        out = self.network(x)
        y = x + (1 - (x * x).sum(dim=-1, keepdim=True)) * out[..., :2]
        return _turned(y, out[..., 2].cos(), out[..., 2].sin())

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        out, jacobian = self.network.value_and_jacobian(x)
        room = 1 - (x * x).sum(dim=-1, keepdim=True)
        y = x + room * out[..., :2]
        eye = torch.eye(2, dtype=x.dtype, device=x.device)
        inner = eye + room[..., None] * jacobian[..., :2, :]
        inner = inner - 2 * out[..., :2, None] * x[..., None, :]
        # d(R y) = R (dy + y⊥ dθ)
        across = torch.stack([-y[..., 1], y[..., 0]], dim=-1)
        inner = inner + across[..., None] * jacobian[..., 2:3, :]
        c, s = out[..., 2].cos(), out[..., 2].sin()
        columns = [_turned(inner[..., k], c, s) for k in (0, 1)]
        return _turned(y, c, s), torch.stack(columns, dim=-1)


class SquareMap(IdentityInitializedMap):
    """h_i(x) = x_i + (1 − x_i²)·N_i(x): each side of the square goes to itself, corners stay."""

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) to (N, 2)."""
        return x + (1 - x * x) * self.network(x)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 2) and Jacobians (N, 2, 2)."""
        out, jacobian = self.network.value_and_jacobian(x)
        room = 1 - x * x
        return x + room * out, torch.diag_embed(1 - 2 * x * out) + room[..., None] * jacobian


def _turned(y: Tensor, c: Tensor, s: Tensor) -> Tensor:
    """y (..., 2) rotated by the angles with cosine c and sine s (...)."""
    return torch.stack([c * y[..., 0] - s * y[..., 1], s * y[..., 0] + c * y[..., 1]], dim=-1)
