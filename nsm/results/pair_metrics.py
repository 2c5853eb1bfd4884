"""Quality of a map between two surfaces, measured on the meshes themselves.

The image of a source vertex is looked up on the target's mesh, so that no figure depends on the
error of a neural surface.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from nsm.domains import Surface, bounded
from nsm.energies import (
    arap,
    area,
    conformal,
    singular_value_ratio,
    symmetric_dirichlet,
)
from nsm.results.map_metrics import flipped_percent, summaries, triangle_metric
from nsm.surfaces.topology import boundary_loops, face_areas

ENERGIES: tuple[Callable[[torch.Tensor, torch.Tensor], torch.Tensor], ...] = (
    symmetric_dirichlet,
    conformal,
    singular_value_ratio,
    area,
    arap,
)
# what is said of a map before its optimization
START = (
    *(f"symmetric_dirichlet_{name}" for name in ("median", "mean", "p95")),
    "conformal_median",
    "singular_value_ratio_median",
    "singular_value_ratio_p95",
    "flipped_percent",
    "landmark_error_max_percent",
)
# precision of a boundary point in float32
ON_BOUNDARY = 1e-6
_COVER_SAMPLES = 20_000
_WORST = 1e3


def triangle_energies(
    source: np.ndarray, image: np.ndarray, faces: np.ndarray
) -> dict[str, np.ndarray]:
    """Each energy (F,) of the triangles, by name; arguments as of :func:`distortion_figures`."""
    a, b = triangle_metric(source, faces), triangle_metric(image, faces)
    return {energy.__name__: energy(a, b).numpy() for energy in ENERGIES}


def distortion_figures(
    source: np.ndarray, image: np.ndarray, faces: np.ndarray
) -> dict[str, float]:
    """Median, area-weighted mean and 95th percentile of each energy over the triangles.

    Args:
        source: vertices (V, 3) of the source mesh.
        image: their images, (V, 3) or (V, 2).
        faces: (F, 3).
    """
    return summaries(triangle_energies(source, image, faces), face_areas(source, faces))


def mean_log_distortion(source: Surface, image: np.ndarray) -> float:
    """Mean logarithm of symmetric Dirichlet over a surface's triangles, weighted by area, as
    :class:`nsm.domains.orbifold.alignment.Alignment` has it; each counts 1,000 at most.

    Args:
        source: the surface.
        image: (V, 3) of its vertices.
    """
    a, b = (triangle_metric(x, source.faces) for x in (source.vertices, image))
    value = np.nan_to_num(symmetric_dirichlet(a, b).numpy(), nan=_WORST).clip(1.0, _WORST)
    return float(np.average(np.log(value), weights=face_areas(source.vertices, source.faces)))


def pair_metrics(
    source: Surface,
    target: Surface,
    image_uv: np.ndarray,
    landmark_image: np.ndarray,
    landmark_target: np.ndarray,
) -> dict[str, float]:
    """The figures of METHOD's "How quality is measured", maps; of a part, without its caps.

    Args:
        source, target: the surfaces.
        image_uv: h at the source's vertices, (V, 2), in the target's domain.
        landmark_image: images of the landmarks by h, (K, 2).
        landmark_target: the landmarks in the target's domain, (K, 2).

    Returns:
        The figures of :func:`distortion_figures`; flipped_percent (signed area in Ω);
        landmark_error_mean_percent and _max_percent, on the target, of its bounding box's
        diagonal, if there are landmarks; covered_percent of the target's area. On a domain with
        boundary also outside_percent of vertices; boundary_distance_max of the boundary's image
        from ∂Ω, in units of Ω; and, if there is a seam, seam_gap_mean_percent and _max_percent,
        the distance on the target between the images of two seam vertices that were one point, of
        the diagonal.
    """
    part, own = source.part, image_uv[source.of_part]
    image = target.at(own)
    to_percent = 100 / target.bounding_box_diagonal
    figures = distortion_figures(part.vertices, image, part.faces)
    figures["flipped_percent"] = flipped_percent(own, part.faces)
    distances = {"landmark_error": _missed(target, landmark_image, landmark_target)}
    if source.domain.has_boundary:
        distance = bounded(source.domain).signed_distance(torch.from_numpy(image_uv)).numpy()
        loop = boundary_loops(source.faces)[0]
        figures["outside_percent"] = 100 * float((distance > ON_BOUNDARY).mean())
        figures["boundary_distance_max"] = float(np.abs(distance[loop]).max())
        a, b = source.seam_pairs.T
        distances["seam_gap"] = np.linalg.norm(image[a] - image[b], axis=1)
    for name, values in distances.items():
        if len(values):
            figures[f"{name}_mean_percent"] = float(values.mean() * to_percent)
            figures[f"{name}_max_percent"] = float(values.max() * to_percent)
    figures["covered_percent"] = _covered_percent(source, target, image_uv)
    return figures


def start_figures(
    source: Surface,
    target: Surface,
    image_uv: np.ndarray,
    landmark_image: np.ndarray,
    landmark_target: np.ndarray,
) -> dict[str, float]:
    """Figures of a map before its optimization: the parameterizations of both surfaces, composed.

    Args:
        source, target, image_uv, landmark_image, landmark_target: as for :func:`pair_metrics`, of
            the map that h starts as.

    Returns:
        symmetric_dirichlet_median, _mean and _p95; conformal_median; singular_value_ratio_median
        and _p95; flipped_percent; landmark_error_max_percent, if there are landmarks: each after
        ``start_``.
    """
    part, own = source.part, image_uv[source.of_part]
    figures = distortion_figures(part.vertices, target.at(own), part.faces)
    figures["flipped_percent"] = flipped_percent(own, part.faces)
    if len(landmark_image):
        off = _missed(target, landmark_image, landmark_target)
        figures["landmark_error_max_percent"] = (
            100 / target.bounding_box_diagonal * float(off.max())
        )
    return {f"start_{name}": figures[name] for name in START if name in figures}


def _missed(target: Surface, image: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Distances (K,) on the target between points (K, 2) of its domain."""
    return np.linalg.norm(target.at(image) - target.at(wanted), axis=1)


def _covered_percent(source: Surface, target: Surface, image_uv: np.ndarray) -> float:
    """Share of the target's area that lies in the image of some triangle of the source."""
    random = np.random.default_rng(0)
    areas = face_areas(target.vertices, target.faces)
    face = random.choice(len(areas), size=_COVER_SAMPLES, p=areas / areas.sum())
    weights = random.dirichlet(np.ones(3), size=_COVER_SAMPLES)
    uv = (weights[:, :, None] * target.uv[target.faces[face]]).sum(axis=1)
    image = source.domain.layout(image_uv, source.faces)
    if source.caps is not None:
        return 100 * float((~source.caps[image.locate(uv).face]).mean())
    nearest = image.carried(uv, image_uv, source.seam_pairs)
    return 100 * float((np.linalg.norm(nearest - uv, axis=1) <= ON_BOUNDARY).mean())
