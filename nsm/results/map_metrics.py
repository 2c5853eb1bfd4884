"""Quality of maps, measured on the source mesh's own triangles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from nsm.domains.planar_mesh import boundary_self_intersections, signed_areas
from nsm.energies import area, conformal, singular_value_ratio, symmetric_dirichlet
from nsm.surfaces.topology import boundary_loops, face_areas


def triangle_metric(points: np.ndarray, faces: np.ndarray) -> torch.Tensor:
    """EᵀE (F, 2, 2) of each triangle's edge vectors E, for points (V, 2) or (V, 3).

    With A of the source and B of the image, A⁻¹B is similar to JᵀJ of the affine map between
    them, as for Jacobians on Ω.
    """
    a, b, c = (points[faces[:, k]] for k in range(3))
    edges = torch.from_numpy(np.stack([b - a, c - a], axis=2)).double()
    return edges.transpose(1, 2) @ edges


def summaries(values: Mapping[str, np.ndarray], weights: np.ndarray) -> dict[str, float]:
    """Median, weighted mean and 95th percentile of each of several quantities (F,), by name."""
    figures: dict[str, float] = {}
    for name, value in values.items():
        figures[f"{name}_median"] = float(np.median(value))
        figures[f"{name}_mean"] = float(np.average(value, weights=weights))
        figures[f"{name}_p95"] = float(np.percentile(value, 95))
    return figures


def flipped_percent(uv: np.ndarray, faces: np.ndarray, *, mirrored: bool = False) -> float:
    """Share of the triangles (F, 3) that images (V, 2) turn over or flatten, in percent.

    Args:
        uv, faces: the image of a mesh.
        mirrored: whether the map may be a mirror image as a whole: the minority is then counted.
    """
    signed = signed_areas(uv, faces)
    turned = int((signed <= 0).sum())
    return 100 * (min(turned, int((signed >= 0).sum())) if mirrored else turned) / len(faces)


def planar_metrics(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> dict[str, float]:
    """Figures of a map of a mesh (V, 3), (F, 3) to the plane (V, 2).

    Returns:
        median, mean and p95 of symmetric_dirichlet (METHOD, Eq. 2), conformal (Eq. 3),
        singular_value_ratio and area over the triangles, the mean weighted by their area on the
        mesh; flipped_percent, of the minority's orientation; boundary_self_intersections:
        a map without flips can still overlap itself.
    """
    source, image = triangle_metric(vertices, faces), triangle_metric(uv, faces)
    energies = (symmetric_dirichlet, conformal, singular_value_ratio, area)
    values = {energy.__name__: energy(source, image).numpy() for energy in energies}
    figures = summaries(values, face_areas(vertices, faces))
    figures["flipped_percent"] = flipped_percent(uv, faces, mirrored=True)
    loop = boundary_loops(faces)[0]
    figures["boundary_self_intersections"] = float(boundary_self_intersections(uv, loop))
    return figures
