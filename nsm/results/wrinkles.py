"""Wrinkles of a neural surface: how much more its normal turns than the source's.

A network can be near its mesh everywhere and still have creases. Distances do not show them, and
normal errors mix them with slow deviations, which are no wrinkles. This module compares how the
normal changes over a short distance on φ and on the source.
"""

from __future__ import annotations

import numpy as np
from torch import nn

from nsm.domains import Surface
from nsm.results.evaluation import evaluate_jacobian
from nsm.results.render import vertex_normals
from nsm.surfaces.location import Places, locate

# in units of the diagonal of the mesh's bounding box
DISTANCE = 0.01


def normal_variation(
    surface: Surface,
    phi: nn.Module,
    *,
    distance: float = DISTANCE,
    samples: int = 20_000,
    seed: int = 0,
) -> dict[str, float]:
    """Compare how the normal changes over a short distance on φ and on the source mesh.

    Points p are uniform by area on the mesh; q is the mesh's point nearest to p moved by
    ``distance`` in a random tangential direction. With n the unit normal of φ at the same uv, m
    that of the mesh (interpolated vertex normals, so that flat triangles are no wrinkles), and
    Δn = n(q) - n(p), Δm likewise. Lengths of differences of unit normals approximate angles in
    radians; where φ has no normal, they count as 180 degrees.

    Args:
        surface: the prepared surface.
        phi: the network, with ``value_and_jacobian``.
        distance: from p to q, in units of the diagonal of the mesh's bounding box.
        samples: number of pairs.
        seed: of the pairs, which no training uses.

    Returns:
        normal_variation_error_degrees, the root mean square of Δn - Δm, 0 if φ bends as the source
        does; normal_variation_excess_degrees, RMS of Δn less RMS of Δm: above 0 φ is more wrinkled
        than its source, below 0 it smooths the source's detail.
    """
    start, end = _ways(surface, distance * surface.bounding_box_diagonal, samples, seed)
    smooth = vertex_normals(surface.vertices, surface.faces, surface.seam_pairs)
    smooth[~smooth.any(axis=1)] = np.nan
    there, mesh = [], []
    for places in (start, end):
        jacobian = evaluate_jacobian(phi, places.take(surface.uv, surface.faces))[1]
        there.append(_unit(np.cross(jacobian[:, :, 0], jacobian[:, :, 1])))
        mesh.append(_unit(places.take(smooth, surface.faces)))
    # leave out points where the mesh has no normal
    known = np.isfinite(mesh[0] + mesh[1]).all(axis=1)
    turned, source = ((a[1] - a[0])[known] for a in (there, mesh))
    return {
        "normal_variation_error_degrees": _rms_degrees(turned - source),
        "normal_variation_excess_degrees": _rms_degrees(turned) - _rms_degrees(source),
    }


def _ways(surface: Surface, length: float, count: int, seed: int) -> tuple[Places, Places]:
    random = np.random.default_rng([seed, 0xBE5D])
    corners = surface.vertices[surface.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    face = random.choice(len(area), size=count, p=area / area.sum())
    start = Places(face, random.dirichlet(np.ones(3), size=count))
    along = _unit(corners[face, 1] - corners[face, 0])
    across = np.cross(_unit(cross[face]), along)
    angle = random.uniform(0, 2 * np.pi, size=(count, 1))
    direction = np.cos(angle) * along + np.sin(angle) * across
    points = start.take(surface.vertices, surface.faces)
    return start, locate(points + length * direction, surface.vertices, surface.faces)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (N, 3) at length 1; not a number where one has no direction."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _rms_degrees(vectors: np.ndarray) -> float:
    """RMS length of vectors (N, 3), read as radians; where there is no normal it counts as π."""
    length = np.linalg.norm(vectors, axis=1)
    return float(np.degrees(np.sqrt((np.where(np.isfinite(length), length, np.pi) ** 2).mean())))
