"""Eigenvalues of the Laplace–Beltrami operator of a surface φ: Ω → R³, by Galerkin's method."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import eigsh

from nsm.energies.metrics import first_fundamental_form
from nsm.energies.operators import Map, jacobian

# barycentric coordinates of the middles of the edges: exact for quadratic functions
_MIDDLES = torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]], dtype=torch.float64)
_CHUNK = 16_384  # triangles


def spectrum(
    phi: Map,
    uv: np.ndarray,
    faces: np.ndarray,
    count: int = 10,
    *,
    joined: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The smallest λ with -Δf = λf, and functions f of them.

    Functions are linear on the triangles of a mesh of Ω; the metric is φ's own, not that of a mesh
    in space. λ solves K f = λ M f with K = ∫ ∇f·∇f dA and M = ∫ f² dA by the midpoints of edges.
    The error is of the order of λ²h², h the length of the edges on the surface. At a boundary the
    normal derivative is zero (Neumann).

    Args:
        phi: points (N, 2) to points (N, n), such as the ``module()`` of a neural surface.
        uv: (V, 2), vertices of the mesh of Ω.
        faces: (F, 3), counter-clockwise.
        count: how many, the constant's λ = 0 among them; less than V.
        joined: (V,) whole numbers, equal for copies of one point of the surface, as at a seam.

    Returns:
        λ (count,), ascending, and functions (V, count), of unit norm and mutually orthogonal on the
        surface; their signs are arbitrary.

    Raises:
        ValueError: shapes do not fit, or count is out of range.
    """
    node = np.arange(len(uv)) if joined is None else np.unique(joined, return_inverse=True)[1]
    node = node.reshape(-1)
    size = int(node.max()) + 1
    if len(node) != len(uv) or not 0 < count < size:
        raise ValueError(f"{count} of {size} functions, {len(node)} joined of {len(uv)} vertices")
    stiffness, mass = _elements(phi, torch.as_tensor(uv, dtype=torch.float64), faces)
    corners = node[faces]
    rows = np.repeat(corners, 3, axis=1).ravel()
    columns = np.tile(corners, (1, 3)).ravel()

    def assembled(of_triangles: np.ndarray) -> csc_matrix:
        entries = (of_triangles.ravel(), (rows, columns))
        return csc_matrix(coo_matrix(entries, shape=(size, size)))

    K, M = assembled(stiffness), assembled(mass)
    shift = -1e-3 * K.diagonal().sum() / M.diagonal().sum()  # K alone is singular
    start = np.random.default_rng(0).normal(size=size)
    values, functions = eigsh(K, k=count, M=M, sigma=shift, which="LM", v0=start)
    order = np.argsort(values)
    return values[order], functions[node][:, order]


@torch.no_grad()
def _elements(phi: Map, uv: torch.Tensor, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The matrices (F, 3, 3) of the triangles: stiffness and mass."""
    found = []
    for part in torch.from_numpy(np.ascontiguousarray(faces, dtype=np.int64)).split(_CHUNK):
        corners = uv[part]
        sides = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], dim=2)
        flat = 0.5 * torch.linalg.det(sides)
        if not bool((flat > 0).all()):
            raise ValueError("triangles of Ω are counter-clockwise, and none is flat")
        inverse = torch.linalg.inv(sides)
        # slopes (F, 3, 2) of the functions that are one at a corner
        slopes = torch.cat([-inverse.sum(dim=1, keepdim=True), inverse], dim=1)
        points = torch.einsum("qk,fkc->fqc", _MIDDLES, corners)
        J = jacobian(phi, points.reshape(-1, 2)).double()
        metric = first_fundamental_form(J).view(len(part), 3, 2, 2)
        E, F, G = metric[..., 0, 0], metric[..., 0, 1], metric[..., 1, 1]
        element = (E * G - F * F).clamp(min=1e-300).sqrt()
        # √g g⁻¹ = adj(g) / √g
        adjugate = torch.stack([torch.stack([G, -F], -1), torch.stack([-F, E], -1)], -2)
        tensor = (adjugate / element[..., None, None]).mean(dim=1) * flat[:, None, None]
        stiffness = slopes @ tensor @ slopes.mT
        weights = element * (flat / 3)[:, None]
        mass = torch.einsum("fq,qi,qj->fij", weights, _MIDDLES, _MIDDLES)
        found.append((stiffness.numpy(), mass.numpy()))
    return np.concatenate([k for k, _ in found]), np.concatenate([m for _, m in found])
