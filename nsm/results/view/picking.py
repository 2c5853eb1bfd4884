"""Picking: the point at which a ray hits one shape, and its image on the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.results.view.scene import Scene
from nsm.surfaces.location import Places


@dataclass(frozen=True)
class Pick:
    """A point on one shape and the corresponding point of the other.

    Attributes:
        side: the shape that was clicked, 0 for the source, 1 for the target.
        places: the point on the source and the one on the target.
        uv: (2, 2) both points in the domains of their shapes.
        coordinates: both points as displayed (see :class:`nsm.results.view.scene.Shape`).
        values: the scene's energies and errors at the point.
        vertices: for both points, the number in the mesh file of the corner of their triangle that
            they are nearest to in barycentric coordinates; -1 if that was inserted.
    """

    side: int
    places: tuple[Places, Places]
    uv: np.ndarray
    coordinates: tuple[np.ndarray, np.ndarray]
    values: dict[str, float]
    vertices: tuple[int, int]


def hit(
    origin: np.ndarray, direction: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[float, Places] | None:
    """The first intersection of a ray with a mesh (Möller and Trumbore 1997), from either side.

    Args:
        origin, direction: (3,) of the ray.
        vertices, faces: the mesh (V, 3), (F, 3).

    Returns:
        The distance in lengths of the direction, and the point; None if the ray misses.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(direction, e2)
    determinant = (e1 * p).sum(axis=1)
    s = origin - a
    q = np.cross(s, e1)
    with np.errstate(divide="ignore", invalid="ignore"):  # the ray is parallel to the triangle
        w1 = (s * p).sum(axis=1) / determinant
        w2 = q @ direction / determinant
        distance = (e2 * q).sum(axis=1) / determinant
        # by rounding, a ray through an edge may miss both of its triangles
        inside = (np.minimum(w1, w2) >= -1e-9) & (w1 + w2 <= 1 + 1e-9) & (distance > 0)
    if not inside.any():
        return None
    face = int(np.where(inside, distance, np.inf).argmin())
    weights = np.clip([1 - w1[face] - w2[face], w1[face], w2[face]], 0, 1)
    weights /= weights.sum()
    return float(distance[face]), Places(np.array([face]), weights[None])


def pick(
    scene: Scene, origin: np.ndarray, direction: np.ndarray, shown: tuple[np.ndarray, np.ndarray]
) -> Pick | None:
    """The first point that a ray hits on the two shapes, and its image.

    Args:
        scene: the shapes and the map.
        origin, direction: (3,) of the ray, in world coordinates.
        shown: the current vertices (V, 3) of both shapes, without the scene's offsets.
    """
    found = []
    for side, (shape, vertices) in enumerate(zip(scene.shapes, shown, strict=True)):
        first = hit(np.asarray(origin) - scene.offsets[side], direction, vertices, shape.faces)
        if first is not None:
            found.append((first[0], side, first[1]))
    if not found:
        return None
    _, side, place = min(found, key=lambda item: item[0])
    return pick_at(scene, side, place)


def pick_at(scene: Scene, side: int, place: Places) -> Pick:
    """The pick of one point on a shape."""
    other = scene.corresponding(side, place)
    places = (place, other) if side == 0 else (other, place)
    ends = list(zip(places, scene.shapes, strict=True))
    uv = np.stack([at.take(shape.uv, shape.faces)[0] for at, shape in ends])
    coordinates = [at.take(shape.coordinates, shape.faces)[0] for at, shape in ends]
    source = places[0]
    values = {name: float(energy[source.face[0]]) for name, energy in scene.energies.items()}
    for name, error in scene.errors.items():
        values[name] = float(source.take(error, scene.source.faces)[0])
    vertices = [int(shape.numbers[_corner(at, shape.faces)]) for at, shape in ends]
    return Pick(
        side, places, uv, (coordinates[0], coordinates[1]), values, (vertices[0], vertices[1])
    )


def _corner(place: Places, faces: np.ndarray) -> int:
    return int(faces[place.face[0], place.weights[0].argmax()])
