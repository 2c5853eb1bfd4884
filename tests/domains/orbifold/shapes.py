"""Closed meshes for the tests of orbifolds and tori."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

TETRAHEDRON = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
)


def hull(seed: int, count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull of random points of a squeezed sphere, outward."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points *= rng.uniform(0.3, 2.0, 3)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = points[faces].transpose(1, 0, 2)
    inward = (np.cross(b - a, c - a) * (a - points.mean(axis=0))).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points, faces


def limbs(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """A sphere with four long limbs, and their tips."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    points = np.array(sphere.vertices)
    tips = np.array([[1, 1, 0.3], [1, -1, -0.2], [-1, -1, 0.1], [-1, 1, 0]])
    tips /= np.linalg.norm(tips, axis=1, keepdims=True)
    near = points @ tips.T
    points *= (1 + 1.5 * np.exp(12 * (near - 1)).sum(axis=1))[:, None]
    return points, np.array(sphere.faces, dtype=np.int64), near.argmax(axis=0).tolist()


def torus(sections: tuple[int, int] = (24, 12)) -> tuple[np.ndarray, np.ndarray]:
    """A bent torus."""
    mesh = trimesh.creation.torus(
        major_radius=1.0, minor_radius=0.4, major_sections=sections[0], minor_sections=sections[1]
    )
    points = np.array(mesh.vertices)
    return points * (1 + 0.2 * np.sin(3 * points[:, :1])), np.array(mesh.faces, dtype=np.int64)
