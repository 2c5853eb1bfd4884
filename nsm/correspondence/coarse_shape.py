"""What the search for correspondences knows of a shape: a coarse mesh, its tips, its distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsm.correspondence.distances import edge_distances
from nsm.correspondence.opened_handles import Opened
from nsm.correspondence.tips import tips_of
from nsm.domains.orbifold.cones import decimated
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.wording import number_of

_FACES = 1000
_TIPS = 8
_SAMPLES = 64
_MOST = 9  # tips and given landmarks, where all may be cones
_AROUND = 0.3  # a tip's neighbourhood, over √area
_LEVEL = 0.02  # mean distances that differ less are alike, over √area
COMMON = 5  # given landmarks from which on four of them are the cones of both
_NEAR = 0.15  # of a tip to a landmark that is given, over √area


@dataclass(frozen=True)
class CoarseShape:
    """A closed surface of genus 0 on about a thousand triangles, of area one.

    Attributes:
        vertices: (V, 3), about the mean of the surface.
        faces: (F, 3).
        ids: (V,) the vertices of the given mesh that are left.
        distance: (V, V) geodesic, along edges.
        mean_distance: (V,) to all points of the surface.
        tips: (K,) vertices far from everything, the most prominent first; given ones before them.
        samples: (M,) vertices that are spread evenly.
        mesh: that it was made from.
        given: how many of the tips are landmarks that were given, or caps.
    """

    vertices: np.ndarray
    faces: np.ndarray
    ids: np.ndarray
    distance: np.ndarray
    mean_distance: np.ndarray
    tips: np.ndarray
    samples: np.ndarray
    mesh: Opened
    given: int = 0

    @property
    def given_landmarks(self) -> int:
        """How many of the tips are landmarks that were given; caps come after them."""
        return self.given - len(self.mesh.caps)

    @property
    def fixed(self) -> np.ndarray:
        """The vertices (given,) of landmarks that were given, and of caps."""
        return self.tips[: self.given]

    def peaks(self) -> np.ndarray:
        """The tips from which the mean distance falls all around; others lie between limbs."""
        around = self.distance[self.tips] < _AROUND
        height = np.where(around, self.mean_distance, 0.0).max(axis=1)
        return self.tips[self.mean_distance[self.tips] > height - _LEVEL]

    def free_peaks(self) -> np.ndarray:
        """Those of them that were not given."""
        return np.setdiff1d(self.peaks(), self.fixed)

    def spread_tips(self, count: int) -> np.ndarray:
        """Numbers of up to ``count`` tips that are far from each other."""
        apart = self.distance[np.ix_(self.tips, self.tips)]
        return _spread(apart, [0], min(count, len(self.tips)))


def coarse_shape(
    vertices: np.ndarray,
    faces: np.ndarray,
    tips: np.ndarray | None = None,
    fixed: np.ndarray | None = None,
    count: int = _FACES,
    opened: Opened | None = None,
) -> CoarseShape:
    """The coarse shape of a closed mesh (V, 3), (F, 3) of genus 0.

    Args:
        vertices, faces: the mesh.
        tips: (K,) vertices that stand for the tips, which are found if not given.
        fixed: (G,) vertices, landmarks that are given, and caps; tips near them are left out.
        count: of its faces, about.
        opened: the mesh, if it is one with handles that were cut open.

    Raises:
        NsmError: ``wrong_topology`` for any other mesh; ``no_proposal`` for one with fewer than
            four tips.
    """
    closed = bool((topology.edges_of(faces).count == 2).all())
    if (
        not closed
        or topology.face_components(faces).max()
        or topology.euler_characteristic(faces) != 2
    ):
        raise NsmError(
            "correspondences without landmarks need closed surfaces, in collections those of "
            "genus 0; give landmarks",
            kind="wrong_topology",
            key="landmarks",
        )
    mesh = Opened.uncut(vertices, faces) if opened is None else opened
    given = 0 if fixed is None else len(fixed)
    if tips is None:
        tips = tips_of(vertices, faces, _TIPS)
        if fixed is not None and given:
            unit = np.sqrt(topology.face_areas(vertices, faces).sum())
            apart = edge_distances(vertices, faces, fixed)[:, tips].min(axis=0) / unit
            others = tips[apart > _NEAR]
            if given - len(mesh.caps) < COMMON:
                others = others[: _MOST - given]
            tips = np.concatenate([fixed, others])
    if len(tips) < 4:
        raise NsmError(
            f"the surface has {number_of(len(tips), 'tip')}, a proposal needs four; give landmarks",
            kind="no_proposal",
            key="landmarks",
        )
    coarse, ids = decimated(vertices, faces, count, tips)
    points = vertices[ids]
    area = topology.face_areas(points, coarse)
    corner = np.bincount(coarse.ravel(), np.repeat(area / 3, 3), minlength=len(ids)) / area.sum()
    points = (points - corner @ points) / np.sqrt(area.sum())
    distance = edge_distances(points, coarse)
    tips = np.searchsorted(ids, tips)
    return CoarseShape(
        points,
        coarse,
        ids,
        distance,
        distance @ corner,
        tips,
        _spread(distance, tips.tolist(), min(_SAMPLES, len(ids))),
        mesh,
        given,
    )


def _spread(distance: np.ndarray, chosen: list[int], count: int) -> np.ndarray:
    """The chosen vertices and, one by one, those farthest from them: (count,)."""
    chosen = list(chosen)
    nearest = distance[chosen].min(axis=0)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, distance[chosen[-1]])
    return np.array(chosen[:count])
