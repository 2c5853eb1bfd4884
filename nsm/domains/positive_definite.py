"""Sparse symmetric positive definite systems."""

from __future__ import annotations

from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu


def factorise(matrix: csc_matrix) -> SuperLU:
    """LU of a symmetric positive definite matrix, with diagonal pivots, as others would cause large
    fill."""
    # supernodes are not enlarged: on meshes that costs more than it saves
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        relax=1,
        panel_size=4,
        options={"SymmetricMode": True},
    )
