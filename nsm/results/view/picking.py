"""From a ray to the point that it meets on one shape, and to that point's image on the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.results.view.scene import Scene
from nsm.surfaces.location import Places


@dataclass(frozen=True)
class Pick:
    """A point on one shape and the point of the other that corresponds to it.

    Attributes:
        side: the shape it was picked on; 0 is the source, 1 the target.
        places: one place on the source and one on the target.
        uv: (2, 2) the two in the domains of their shapes.
        own: the two points as they are told (see :class:`nsm.results.view.scene.Shape`).
        values: the scene's energies and errors there.
    """

    side: int
    places: tuple[Places, Places]
    uv: np.ndarray
    own: tuple[np.ndarray, np.ndarray]
    values: dict[str, float]


def hit(
    origin: np.ndarray, direction: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[float, Places] | None:
    """Where a ray first meets a mesh, from either side of a triangle.

    Args:
        origin, direction: (3,) of the ray.
        vertices, faces: the mesh (V, 3), (F, 3).

    Returns:
        How far, in lengths of the direction, and the one place; None if the ray misses. After
        Möller and Trumbore 1997.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(direction, e2)
    determinant = (e1 * p).sum(axis=1)
    s = origin - a
    q = np.cross(s, e1)
    with np.errstate(divide="ignore", invalid="ignore"):  # triangles seen edge-on
        w1 = (s * p).sum(axis=1) / determinant
        w2 = q @ direction / determinant
        distance = (e2 * q).sum(axis=1) / determinant
        # a ray through an edge may round to the outside of both of its triangles
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
    """The point that a ray meets first of the two shapes, and its image.

    Args:
        scene: the shapes and the map.
        origin, direction: (3,) of the ray, in the world.
        shown: the vertices (V, 3) of both as they are now, without the scene's offsets.
    """
    found = []
    for side, (shape, vertices) in enumerate(zip(scene.shapes, shown, strict=True)):
        met = hit(np.asarray(origin) - scene.offsets[side], direction, vertices, shape.faces)
        if met is not None:
            found.append((met[0], side, met[1]))
    if not found:
        return None
    _, side, place = min(found, key=lambda one: one[0])
    return picked(scene, side, place)


def picked(scene: Scene, side: int, place: Places) -> Pick:
    """The pick of one place on a shape."""
    other = scene.across(side, place)
    places = (place, other) if side == 0 else (other, place)
    ends = list(zip(places, scene.shapes, strict=True))
    uv = np.stack([at.take(shape.uv, shape.faces)[0] for at, shape in ends])
    own = [at.take(shape.own, shape.faces)[0] for at, shape in ends]
    there = places[0]
    values = {name: float(known[there.face[0]]) for name, known in scene.energies.items()}
    for name, known in scene.errors.items():
        values[name] = float(there.take(known, scene.source.faces)[0])
    return Pick(side, places, uv, (own[0], own[1]), values)
