"""Quality of a neural surface, measured on points that no training has seen."""

from __future__ import annotations

import numpy as np
from torch import nn

from nsm.domains import Surface
from nsm.results.evaluation import evaluate, evaluate_jacobian
from nsm.results.wrinkles import normal_variation
from nsm.surfaces.geometry import point_mesh_distance, subdivide

# A triangle whose area φ shrinks below this share of the true one has collapsed.
DEGENERATE_STRETCH = 1e-3
# meshes with fewer triangles are subdivided to show the shape of φ
FINE_ENOUGH = 500_000
# of φ's points, whose distances to the mesh are measured
MOST_POINTS = 500_000


def vertex_error(surface: Surface, phi: nn.Module) -> np.ndarray:
    """Distance (V,) between φ and the mesh at each vertex, in percent of the diagonal."""
    distance = np.linalg.norm(evaluate(phi, surface.uv) - surface.vertices, axis=1)
    return 100 * distance / surface.bounding_box_diagonal


def pointwise_metrics(
    surface: Surface, phi: nn.Module, *, samples: int = 100_000, seed: int = 0
) -> dict[str, float]:
    """The cheap figures of :func:`overfit_metrics`: errors at matching uv.

    Args:
        surface, phi, samples, seed: as there.

    Returns:
        rms_percent and max_percent; normal_error_mean_degrees, normal_error_p95_degrees.
    """
    cross, double_area = _cross_and_double_area(surface)
    normals = cross / np.maximum(double_area, 1e-300)[:, None]
    uv, points, face = _random_points(surface, double_area, samples, seed)
    value, jacobian = evaluate_jacobian(phi, uv)
    distance = 100 / surface.bounding_box_diagonal * np.linalg.norm(value - points, axis=1)
    angle = _angles(np.cross(jacobian[:, :, 0], jacobian[:, :, 1]), normals[face])
    return {
        "rms_percent": float(np.sqrt((distance**2).mean())),
        "max_percent": float(distance.max()),
        "normal_error_mean_degrees": float(angle.mean()),
        "normal_error_p95_degrees": float(np.percentile(angle, 95)),
    }


def overfit_metrics(
    surface: Surface, phi: nn.Module, *, samples: int = 100_000, seed: int = 0
) -> dict[str, float]:
    """The figures of METHOD's "How quality is measured" for an overfitted network.

    Distances are in percent of the diagonal of the mesh's bounding box, angles in degrees.

    Args:
        surface: the prepared surface.
        phi: the network, with ``value_and_jacobian``.
        samples: number of points, uniform by area on the mesh.
        seed: of these points, which no training uses.

    Returns:
        rms_percent and max_percent at matching uv; hausdorff_mesh_to_phi_percent and
        hausdorff_phi_to_mesh_percent, one-sided; normal_error_mean_degrees,
        normal_error_p95_degrees; degenerate_triangles_percent; on a domain with boundary,
        seam_gap_percent, the largest distance between the images of two seam vertices that were
        one point; and the figures of
        :func:`nsm.results.wrinkles.normal_variation`.
    """
    to_percent = 100 / surface.bounding_box_diagonal
    double_area = _cross_and_double_area(surface)[1]
    points = _random_points(surface, double_area, samples, seed)[1]

    # φ's surface as a mesh finer than the source, for the distances between the two
    fine_uv, fine_faces = surface.uv, surface.faces
    if len(fine_faces) < FINE_ENOUGH:
        fine_uv, fine_faces = subdivide(fine_uv, fine_faces)
    image = evaluate(phi, fine_uv)
    there = point_mesh_distance(points, image, fine_faces)
    some = image[:: len(image) // MOST_POINTS + 1]
    back = point_mesh_distance(some, surface.vertices, surface.faces)
    seam = {}
    if surface.domain.has_boundary:
        seam["seam_gap_percent"] = seam_gap(surface, phi) * to_percent
    return {
        **pointwise_metrics(surface, phi, samples=samples, seed=seed),
        "hausdorff_mesh_to_phi_percent": float(there.max() * to_percent),
        "hausdorff_phi_to_mesh_percent": float(back.max() * to_percent),
        "degenerate_triangles_percent": 100 * _degenerate_share(surface, phi, double_area),
        **seam,
        **normal_variation(surface, phi, seed=seed),
    }


def seam_gap(surface: Surface, phi: nn.Module) -> float:
    """The largest distance between φ's images of two copies of a vertex."""
    pairs = evaluate(phi, surface.uv[surface.seam_pairs.ravel()]).reshape(-1, 2, 3)
    return float(np.linalg.norm(pairs[:, 0] - pairs[:, 1], axis=1).max(initial=0.0))


def _cross_and_double_area(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Cross products (F, 3) of the triangles' sides, and their lengths (F,)."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    return cross, np.linalg.norm(cross, axis=1)


def _random_points(
    surface: Surface, area: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """uv (N, 2), points (N, 3) and faces (N,), uniform by area on the mesh."""
    random = np.random.default_rng([seed, 0xFACE])
    face = random.choice(len(area), size=count, p=area / area.sum())
    root, r = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - root, root * (1 - r), root * r], axis=1)[:, :, None]
    corners = surface.faces[face]
    uv = (weights * surface.uv[corners]).sum(axis=1)
    return uv, (weights * surface.vertices[corners]).sum(axis=1), face


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (N,) between vectors (N, 3), in degrees; 180 where one is not finite.

    By the arc tangent: the arc cosine of float values near 1 would not resolve small angles.
    """
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    angle = np.degrees(np.arctan2(sine, (a * b).sum(axis=1)))
    return np.where(np.isfinite(angle), angle, 180.0)


def _degenerate_share(surface: Surface, phi: nn.Module, double_area: np.ndarray) -> float:
    center = surface.uv[surface.faces].mean(axis=1)
    jacobian = evaluate_jacobian(phi, center)[1]
    element = np.linalg.norm(np.cross(jacobian[:, :, 0], jacobian[:, :, 1]), axis=1)
    a, b, c = (surface.uv[surface.faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    flat = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    good = element * flat >= DEGENERATE_STRETCH * double_area
    return float(1 - good.mean())
