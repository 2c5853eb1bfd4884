"""Landmarks of several surfaces, matched in their domains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nsm.domains.base import BoundedDomain
from nsm.domains.common_seams import aligned_keys, boundary_keys
from nsm.domains.surface import Surface
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.landmarks import MISSING


def with_ends(surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Landmarks (L,) of surfaces, and after them the corresponding vertices (L + J,) at which the
    cuts end on the boundaries, if the surfaces were cut together."""
    ends = [s.ends[1:] for s in surfaces if s.ends is not None]
    if not cut_together(surfaces) or not ends:
        return list(landmarks)
    known = np.any([np.isin(e, ids) for e, ids in zip(ends, landmarks, strict=True)], axis=0)
    return [np.concatenate([ids, e[~known]]) for ids, e in zip(landmarks, ends, strict=True)]


def cut_together(surfaces: Sequence[Surface]) -> bool:
    """Whether the cuts between the boundaries of open surfaces correspond."""
    numbers = {None if s.ends is None else int(s.ends[0]) for s in surfaces}
    return len(numbers) == 1 and None not in numbers


@dataclass(frozen=True)
class Matched:
    """Landmarks found in the domains of several surfaces.

    points: (K, 2) in Ω, one array per surface, NaN for a landmark that the surface lacks; numbers:
    (K,) which landmark each is. The first
    ``on_boundary`` lie on ∂Ω, in the order in which it is walked counter-clockwise; a landmark on
    the seam is there once for each time that the walk passes it.
    """

    points: list[np.ndarray]
    numbers: np.ndarray
    on_boundary: int

    def shared(self, i: int, j: int) -> np.ndarray:
        """Mask (K,) of the landmarks that two surfaces have."""
        return np.asarray(np.isfinite(self.points[i] + self.points[j]).all(axis=1))

    def seam(self, domain: BoundedDomain, count: int) -> np.ndarray:
        """(T, 2, 2) pairs of points of ∂Ω that are one point of each surface with this seam.

        The walk around ∂Ω passes each branch of the seam twice, out and back. ``count`` points on
        the way out are paired with those on the way back at the same shares of the length. Nothing
        is paired where the walk is not around a tree, or several branches join two landmarks.
        """
        numbers = self.numbers[: self.on_boundary].tolist()
        t = domain.boundary_fractions(self.points[0][: self.on_boundary])
        ways = {
            (numbers[k], numbers[(k + 1) % len(numbers)]): (
                t[k],
                (t[(k + 1) % len(numbers)] - t[k]) % 1.0 or 1.0,
            )
            for k in range(len(numbers))
        }
        if len(ways) < len(numbers):
            return np.zeros((0, 2, 2))
        share = (np.arange(count) + 0.5) / count
        pairs = []
        for (a, b), (begin, span) in ways.items():
            if a < b and (b, a) in ways:
                back, width = ways[b, a]
                both = (begin + span * share, back + width * (1 - share))
                pairs.append(np.stack([domain.boundary_points(w % 1.0) for w in both], axis=1))
        return np.concatenate(pairs) if pairs else np.zeros((0, 2, 2))


def matched_landmarks(surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray]) -> Matched:
    """Corresponding points in the domains of surfaces.

    A landmark on the seam has several preimages on ∂Ω; they correspond in the order in which the
    boundary passes them. On a closed domain each has one, in one of its lifts.

    Args:
        surfaces: all of one domain.
        landmarks: vertices (L,) of each one's mesh file; -1 for one that a surface lacks.

    Raises:
        NsmError: a landmark that is not on its surface, or boundaries that do not correspond.
    """
    if not surfaces[0].domain.has_boundary:
        points = [_places(s, ids) for s, ids in zip(surfaces, landmarks, strict=True)]
        return Matched(points, np.arange(len(landmarks[0])), 0)
    everywhere: np.ndarray = np.all(np.stack(landmarks) >= 0, axis=0)
    keys = []
    for s, ids in zip(surfaces, landmarks, strict=True):
        kept = np.full(len(ids), MISSING)
        kept[ids >= 0] = s.kept(ids[ids >= 0].tolist())
        key = boundary_keys(s.source_vertex, topology.boundary_loops(s.faces)[0], kept)
        for k in key[~everywhere[key[:, 0]], 0][:1].tolist():
            raise NsmError(
                f"landmark {k} is on the boundary of {s.name}, or on its cut, and other surfaces "
                "lack it; leave it out, or move it off the boundary",
                kind="no_common_seam",
                key="landmarks",
            )
        keys.append(key)
    aligned = aligned_keys(keys, [s.uv[key[:, 1]] for s, key in zip(surfaces, keys, strict=True)])
    if aligned is None:
        names = " and ".join(s.name for s in surfaces)
        raise NsmError(
            f"the boundaries of {names}, once cut, pass the landmarks differently; give meshes "
            "instead of ready surfaces, so that their seams correspond, or other landmarks",
            kind="no_common_seam",
            key="landmarks",
        )
    inner = np.setdiff1d(np.arange(len(landmarks[0])), keys[0][:, 0])
    points = [
        np.concatenate([s.uv[key[:, 1]], _places(s, ids[inner])])
        for s, key, ids in zip(surfaces, aligned, landmarks, strict=True)
    ]
    return Matched(points, np.concatenate([aligned[0][:, 0], inner]), len(aligned[0]))


def _places(surface: Surface, ids: np.ndarray) -> np.ndarray:
    """Points (L, 2) of Ω of vertices (L,) of the mesh file; NaN for those that it lacks."""
    points = np.full((len(ids), 2), np.nan)
    points[ids >= 0] = surface.preimages(ids[ids >= 0].tolist())
    return points
