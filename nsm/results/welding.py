"""Weld: one image for all copies of a vertex on a seam, so that a mapped closed mesh is closed.

On domains with a boundary, surfaces are cut, and a map sends the copies of a seam vertex to points
of the target that lie close together, but apart. The weld puts them into one point between, which
may turn triangles at the seam over. These are counted, and turned back by moving seam vertices
alone as far as that is possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linprog

from nsm.domains import Surface
from nsm.surfaces.cutting import chords_joined
from nsm.surfaces.location import Places, locate

_SWEEPS = 20


@dataclass(frozen=True)
class Weld:
    """Images of a surface's vertices on another, the same for all copies of a vertex.

    Attributes:
        places: (V,) on the target's faces.
        points: (V, 3) in the target's normalised units.
        corners: (F, 3) the triangles of the source before points were inserted, by its vertices.
        faces: (F, 3) the same before the mesh was cut, by vertices of its file.
        flipped_triangles: how many the weld turned against the target: their normal and the mean
            of the target's normals at their corners made a sharp angle before, but do not now.
        largest_move: of a copy's image, in the target's normalised units.
    """

    places: Places = field(repr=False)
    points: np.ndarray = field(repr=False)
    corners: np.ndarray = field(repr=False)
    faces: np.ndarray = field(repr=False)
    flipped_triangles: int
    largest_move: float

    def figures(self, diagonal: float) -> dict[str, float]:
        """welded_flipped_triangles, and welded_move_max_percent of the target's diagonal."""
        return {
            "welded_flipped_triangles": self.flipped_triangles,
            "welded_move_max_percent": 100 * self.largest_move / diagonal,
        }


def weld(
    source: Surface, target: Surface, places: Places, kept: Sequence[int] | np.ndarray = ()
) -> Weld:
    """Weld the seam of a mapped surface.

    Args:
        source, target: the surfaces.
        places: (V,) where the map sends the source's vertices, on the target's faces.
        kept: vertices of the source, such as landmarks, whose other copies go to their image.
    """
    corners, rejoined, _ = chords_joined(source.faces, source.source_vertex == -1)
    faces = source.source_vertex[corners]
    ids, first, number, count = np.unique(
        source.source_vertex, return_index=True, return_inverse=True, return_counts=True
    )
    number = number.reshape(-1)
    held = np.asarray(kept, dtype=np.int64)
    first[number[held]] = held
    before = places.take(target.vertices, target.faces)
    image = _Image(target, Places(places.face[first], places.weights[first]))
    on_seam = (count > 1) & (ids >= 0)
    movable = on_seam.copy()
    movable[number[held]] = False
    _to_middles(image, places, before, number, movable)
    compact = np.searchsorted(ids, faces)
    judged = on_seam[compact].any(axis=1) | rejoined
    judged &= _Image(target, places).heights(corners) > 0
    compact = compact[judged]
    _relax(image, compact, movable, places, number)
    single = source.source_vertex < 0  # points inserted between vertices have no copies
    face = np.where(single, places.face, image.places.face[number])
    weights = np.where(single[:, None], places.weights, image.places.weights[number])
    points = np.where(single[:, None], before, image.points[number])
    moves = np.linalg.norm(points - before, axis=1)
    flips = int((image.heights(compact) <= 0).sum())
    own = (faces >= 0).all(axis=1)  # not over filled holes
    largest = float(moves.max(initial=0.0))
    return Weld(Places(face, weights), points, corners[own], faces[own], flips, largest)


class _Image:
    """Vertices (K,) on a target surface: their places, points and the target's normals there."""

    def __init__(self, target: Surface, places: Places) -> None:
        self.target, self.places = target, Places(places.face.copy(), places.weights.copy())
        corners = target.vertices[target.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # copies of a vertex are one point of the target
        joined = np.arange(len(target.vertices))
        joined[target.seam_pairs[:, 1]] = target.seam_pairs[:, 0]
        total = np.zeros_like(target.vertices)
        for k in range(3):
            np.add.at(total, joined[target.faces[:, k]], cross)
        self.of_vertex = _unit(total[joined])
        self.points, self.normals = self.at(self.places)

    def at(self, places: Places) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) and unit normals (N, 3)."""
        faces = self.target.faces
        return places.take(self.target.vertices, faces), _unit(places.take(self.of_vertex, faces))

    def nearest(self, points: np.ndarray) -> Places:
        return locate(points, self.target.vertices, self.target.faces)

    def move(self, which: np.ndarray, places: Places) -> None:
        self.places.face[which], self.places.weights[which] = places.face, places.weights
        self.points[which], self.normals[which] = self.at(places)

    def heights(self, faces: np.ndarray) -> np.ndarray:
        """Signed areas (F,) over the longest sides of triangles (F, 3): negative if turned over."""
        p = self.points[faces]
        normal = _unit(self.normals[faces].sum(axis=1))
        double = (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) * normal).sum(axis=1)
        side = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2).max(axis=1)
        return double / np.maximum(side, 1e-300)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _to_middles(
    image: _Image, places: Places, before: np.ndarray, number: np.ndarray, movable: np.ndarray
) -> None:
    """Move vertices to the point of the target nearest to the mean of their copies' images.

    Not where it is on another sheet: farther than the copies are, or facing another way. There,
    the first copy's image stays.

    Args:
        places, before: (V,) and (V, 3) the copies' images.
        number: (V,) the vertex of each.
        movable: (K,) mask of vertices.
    """
    count = np.bincount(number, minlength=len(movable))
    total = np.stack([np.bincount(number, x, len(movable)) for x in before.T], axis=1)
    mean = total / count[:, None]
    which = np.flatnonzero(movable)
    if not len(which):
        return
    found = image.nearest(mean[which])
    spot, normal = image.at(found)
    reach = np.zeros(len(movable))
    np.maximum.at(reach, number, 2 * np.linalg.norm(before - mean[number], axis=1))
    slot = np.full(len(movable), -1)
    slot[which] = np.arange(len(which))
    copies = np.flatnonzero(movable[number])
    of = slot[number[copies]]
    _, own = image.at(Places(places.face[copies], places.weights[copies]))
    same = (own * normal[of]).sum(axis=1) > 0
    same &= np.linalg.norm(spot[of] - before[copies], axis=1) <= reach[number[copies]]
    good = reach[which] > 0  # copies that are together already stay
    np.logical_and.at(good, of, same)
    image.move(which[good], Places(found.face[good], found.weights[good]))


def _relax(
    image: _Image, faces: np.ndarray, movable: np.ndarray, places: Places, number: np.ndarray
) -> None:
    """Move vertices of turned triangles to where fewer of theirs are turned.

    Args:
        faces: (F, 3) triangles that should not be turned, all those at the vertices that may move.
        movable: (K,) mask of them.
        places: (V,) the copies' images, and number: (V,) the vertex of each.
    """
    for _ in range(_SWEEPS):
        bad = np.unique(faces[image.heights(faces) <= 0])
        bad = bad[movable[bad]]
        if not len(bad):
            return
        stars = [faces[(faces == v).any(axis=1)] for v in bad.tolist()]
        middles = image.nearest(
            np.stack([_kernel(image, v, star) for v, star in zip(bad, stars, strict=True)])
        )
        moved = False
        for k, (v, star) in enumerate(zip(bad.tolist(), stars, strict=True)):
            own = np.flatnonzero(number == v)
            face = np.concatenate([middles.face[[k]], places.face[own]])
            weights = np.concatenate([middles.weights[[k]], places.weights[own]])
            moved |= _best(image, v, star, Places(face, weights))
        if not moved:
            return


def _best(image: _Image, vertex: int, star: np.ndarray, places: Places) -> bool:
    """Move a vertex to the place, of (N,), where fewest of its triangles (S, 3) are turned, or
    leave it if none is better; whether it moved."""

    def score() -> tuple[int, float]:
        heights = image.heights(star)
        return -int((heights <= 0).sum()), float(heights.min())

    here = np.array([vertex])
    old = Places(image.places.face[here], image.places.weights[here])
    best, value = old, score()
    start = value
    for k in range(len(places.face)):
        trial = Places(places.face[[k]], places.weights[[k]])
        image.move(here, trial)
        if score() > value and score()[0] > start[0]:
            best, value = trial, score()
    image.move(here, best)
    return value[0] > start[0]


def _kernel(image: _Image, vertex: int, star: np.ndarray) -> np.ndarray:
    """The point (3,) of the tangent plane at a vertex that is deepest inside the lines through the
    opposite sides of its triangles (S, 3): its star's kernel, if there is one."""
    at: np.ndarray = image.points[vertex]
    normal: np.ndarray = image.normals[vertex]
    least = int(np.abs(normal).argmin())
    u = _unit(np.cross(normal, np.eye(3)[least])[None])[0]
    axes = np.stack([u, np.cross(normal, u)])
    k = (star == vertex).argmax(axis=1)
    rows = np.arange(len(star))
    b, c = ((image.points[star[rows, (k + step) % 3]] - at) @ axes.T for step in (1, 2))
    side = c - b
    inward = _unit(np.stack([-side[:, 1], side[:, 0]], axis=1))
    # maximise r with inward · (x - b) >= r
    system = np.concatenate([-inward, np.ones((len(star), 1))], axis=1)
    reach = float(np.abs([b, c]).max())
    limits = [(-reach, reach), (-reach, reach), (None, None)]
    found = linprog([0, 0, -1], A_ub=system, b_ub=-(inward * b).sum(axis=1), bounds=limits)
    return at + found.x[:2] @ axes if found.status == 0 else at
