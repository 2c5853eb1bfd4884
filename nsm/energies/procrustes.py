"""The rotation about the origin that best carries one set of landmarks onto another."""

from __future__ import annotations

import torch
from torch import Tensor


def rotation(source: Tensor, target: Tensor) -> Tensor:
    """R minimising Σ‖R P_i − Q_i‖² among rotations (no reflections, no translation: Ω is fixed).

    In the plane the minimiser is the angle of Σ conj(P_i)·Q_i, read as complex numbers; no SVD
    is needed. The identity answers where every rotation is as good as another: without
    landmarks, with all of them at the origin, or when they cancel.

    Args:
        source: P (L, 2).
        target: Q (L, 2).

    Returns:
        R (2, 2), to be applied as ``points @ R.T``; of the type of ``source``.

    Raises:
        ValueError: the shapes are not both (L, 2).
    """
    if source.ndim != 2 or source.shape[1] != 2 or source.shape != target.shape:
        raise ValueError(
            f"landmarks are (L, 2) each, not {tuple(source.shape)} and {tuple(target.shape)}"
        )
    p, q = source.double(), target.double()
    cosine = (p * q).sum()
    sine = (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()
    length = torch.hypot(cosine, sine)
    resolved = torch.finfo(source.dtype).eps * p.norm() * q.norm()
    if not length > resolved:
        return torch.eye(2, dtype=source.dtype, device=source.device)
    c, s = cosine / length, sine / length
    return torch.stack([torch.stack([c, -s]), torch.stack([s, c])]).to(source.dtype)
