"""The published recipe of one training step, restated to compare its cost.

Jacobians come from one ``autograd.grad`` with a separate graph per output, tangent frames from a
batched SVD, and distortions from explicit inverses.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

EPSILON = 0.01


def jacobian(y: Tensor, x: Tensor) -> Tensor:
    """The Jacobians (N, n, 2) of outputs y (N, n) with respect to points x (N, 2)."""
    rows = [torch.autograd.grad(y[:, i].sum(), x, create_graph=True)[0] for i in range(y.shape[1])]
    return torch.stack(rows, dim=1)


def overfit(phi: nn.Module, uv: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    """Eq. 1 with λ_n = 0.01."""
    x = uv.clone().requires_grad_()
    value = phi(x)
    j = jacobian(value, x)
    normal = nn.functional.normalize(torch.linalg.cross(j[:, :, 0], j[:, :, 1]), dim=1)
    position = ((value - points) ** 2).sum(dim=1).mean()
    return position + 0.01 * ((normal - normals) ** 2).sum(dim=1).mean()


def _flattened(j: Tensor) -> Tensor:
    """J_φ (N, 3, 2) in an orthonormal frame of the tangent plane, (N, 2, 2)."""
    frame, _, _ = torch.linalg.svd(j.detach(), full_matrices=False)
    return frame.transpose(1, 2) @ j


def _dirichlet(j: Tensor) -> Tensor:
    m = j.transpose(1, 2) @ j
    shifted = m + EPSILON * torch.eye(2, device=j.device)
    trace = m.diagonal(dim1=1, dim2=2).sum(dim=1)
    return trace + torch.linalg.inv(shifted).diagonal(dim1=1, dim2=2).sum(dim=1)


def _injectivity(j: Tensor) -> Tensor:
    det = torch.linalg.det(j)
    return 100 * (-det.sign() * torch.exp(-det)).clamp(min=0).mean()


def _boundary(h: nn.Module, boundary_points: Tensor) -> Tensor:
    return 1e6 * ((h(boundary_points).norm(dim=1) - 1) ** 2).mean()


def param(phi: nn.Module, h: nn.Module, uv: Tensor) -> Tensor:
    """Symmetric Dirichlet energy of the map from φ's surface to the plane, with G."""
    x = uv.clone().requires_grad_()
    source, planar = jacobian(phi(x), x), jacobian(h(x), x)
    j = planar @ torch.linalg.inv(_flattened(source))
    return _dirichlet(j).mean() + _injectivity(planar)


def pair_map(
    phi: nn.Module, psi: nn.Module, h: nn.Module, uv: Tensor, boundary_points: Tensor
) -> Tensor:
    """Symmetric Dirichlet energy of the map f∘φ = ψ∘h, with B and G."""
    x = uv.clone().requires_grad_()
    image = h(x)
    source, planar = jacobian(phi(x), x), jacobian(image, x)
    target = jacobian(psi(image), x)
    j = target @ torch.linalg.inv(_flattened(source))
    return _dirichlet(j).mean() + _injectivity(planar) + _boundary(h, boundary_points)


def collection_map(
    phis: Sequence[nn.Module], maps: Sequence[nn.Module], uv: Tensor, boundary_points: Tensor
) -> Tensor:
    """The mean of that energy over all ordered pairs, with B and G of every map."""
    x = uv.clone().requires_grad_()
    total, curves = uv.new_zeros(()), []
    for phi, h in zip(phis, maps, strict=True):
        image = h(x)
        total = total + _injectivity(jacobian(image, x)) + _boundary(h, boundary_points)
        curves.append(jacobian(phi(image), x))
    pairs = [(i, j) for i in range(len(phis)) for j in range(len(phis)) if i != j]
    for i, j in pairs:
        f = curves[j] @ torch.linalg.inv(_flattened(curves[i]))
        total = total + _dirichlet(f).mean() / len(pairs)
    return total
