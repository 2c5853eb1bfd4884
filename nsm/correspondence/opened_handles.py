"""Closed shapes with handles cut open around these, and capped, so that they are of genus 0.

A handle is cut around its tube: along a short closed curve that bounds a disc within the solid, and
does not separate the surface. So a cup is cut at its handle, and not around the hole of the handle,
whichever is shorter. Each cut leaves two stubs with a cap each, which are further tips.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product

import numpy as np

from nsm.correspondence.tips import mean_distances
from nsm.domains.orbifold.cones import decimated
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.homology import ShortLoops, lifted, linking_number, short_loops
from nsm.wording import number_of

_FACES = 4000
_ROOTS = 300  # vertices through which curves are looked for
_LONGER = 1.3  # of the shortest curve around a tube: still around its thin part
_MOST_HANDLES = 4
_APART = 0.1  # of places on a tube, over √area
_WAYS = 16  # at most
_PLACES = 10  # on a tube, at most


@dataclass(frozen=True)
class Opened:
    """A closed mesh of genus 0, the given one or what is left of it, cut open and capped.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3).
        origin: (V,) the vertex of the given mesh that each is; of the middle of a cap, one beside
            it.
        caps: (2 g,) vertices in the middles of caps; the two of a handle follow each other.
    """

    vertices: np.ndarray
    faces: np.ndarray
    origin: np.ndarray
    caps: np.ndarray

    @classmethod
    def uncut(cls, vertices: np.ndarray, faces: np.ndarray) -> Opened:
        """A closed mesh (V, 3), (F, 3) of genus 0 as it is."""
        return cls(vertices, faces, np.arange(len(vertices)), np.zeros(0, dtype=np.int64))

    def orders(self) -> Iterator[np.ndarray]:
        """Orders (2 g,) of the caps: handles exchanged, and the two caps of each."""
        genus = len(self.caps) // 2
        for handles in permutations(range(genus)):
            for turned in product((0, 1), repeat=genus):
                yield np.array(
                    [
                        2 * handle + (side + turn) % 2
                        for handle, turn in zip(handles, turned, strict=True)
                        for side in (0, 1)
                    ],
                    dtype=np.int64,
                )

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces."""
        return self.vertices, self.faces

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces before the cut, numbered as the given mesh; it has other vertices."""
        points = np.zeros((int(self.origin.max()) + 1, 3))
        points[self.origin[::-1]] = self.vertices[::-1]  # of caps, those on the surface
        kept = ~np.isin(self.faces, self.caps).any(axis=1)
        return points, self.origin[self.faces[kept]]


def ways_to_open(vertices: np.ndarray, faces: np.ndarray, fixed: np.ndarray) -> list[Opened]:
    """Ways to cut a closed mesh (V, 3), (F, 3) open around its handles, on about 4,000 faces.

    In the first, each handle is cut where its tube is farthest from the rest of the shape.

    Args:
        vertices, faces: the mesh.
        fixed: (G,) vertices that no cut touches.

    Raises:
        NsmError: ``no_proposal``: too many handles, or no cuts that keep apart.
    """
    genus = topology.genus_and_boundary(faces)[0]
    if genus > _MOST_HANDLES:
        raise NsmError(
            f"the surface has {genus} handles, a proposal can be made for up to {_MOST_HANDLES}; "
            "give landmarks",
            kind="no_proposal",
            key="landmarks",
        )
    coarse, ids = decimated(vertices, faces, _FACES, fixed)
    points = vertices[ids]
    found = []
    for loops in _choices(points, coarse, np.searchsorted(ids, fixed)):
        one = _opened(points, coarse, loops)
        if one is not None:
            found.append(Opened(one.vertices, one.faces, ids[one.origin], one.caps))
        if len(found) == _WAYS:
            break
    if not found:
        raise NsmError(
            f"no cuts open the {number_of(genus, 'handle')} of the surface; give landmarks",
            kind="no_proposal",
            key="landmarks",
        )
    return found


def _choices(
    vertices: np.ndarray, faces: np.ndarray, fixed: np.ndarray
) -> Iterator[list[np.ndarray]]:
    """Curves around all tubes, one around each; the first choice is the preferred one."""
    genus = topology.genus_and_boundary(faces)[0]
    roots = decimated(vertices, faces, 2 * _ROOTS)[1]
    short = short_loops(vertices, faces, roots)
    classes = _around_tubes(vertices, faces, short)
    area = topology.face_areas(vertices, faces)
    mean = mean_distances(vertices, faces, area)
    tubes: list[list[np.ndarray]] = []
    for one in classes:
        places = _places(short, one, mean, fixed, _APART * float(np.sqrt(area.sum())))
        tubes.append(places[: max(1, min(_PLACES, int(_WAYS ** (1 / genus) + 1e-9)))])
    for numbers in sorted(product(*(range(len(t)) for t in tubes)), key=sum):
        yield [tube[k] for tube, k in zip(tubes, numbers, strict=True)]


def _places(
    short: ShortLoops, one: int, mean: np.ndarray, fixed: np.ndarray, apart: float
) -> list[np.ndarray]:
    """Short curves of a class, far from each other, first the one farthest from everything."""
    length = short.length[:, one - 1]
    numbers = np.flatnonzero(length <= _LONGER * length.min())
    loops = [short.loops[k][one - 1] for k in numbers.tolist()]
    free = [k for k, loop in enumerate(loops) if not np.isin(loop, fixed).any()]
    if not free:
        return []
    far = np.array([mean[loops[k]].mean() for k in free])
    chosen = [free[int(far.argmax())]]
    while True:
        gaps = np.array(
            [min(short.distance[numbers[k], loops[c]].min() for c in chosen) for k in free]
        )
        if gaps.max() < apart:
            return [loops[k] for k in chosen]
        chosen.append(free[int(gaps.argmax())])


def _around_tubes(vertices: np.ndarray, faces: np.ndarray, short: ShortLoops) -> list[int]:
    """Independent classes (g,) of curves that bound discs within the solid, shortest first.

    Where linking numbers do not tell, as of a surface that meets itself, of any curves.
    """
    order = np.argsort(short.length.min(axis=0), kind="stable") + 1
    basis = _independent(order.tolist())
    genus = len(basis) // 2
    best = {c: short.loops[int(short.length[:, c - 1].argmin())][c - 1] for c in order.tolist()}
    off = lifted(vertices, faces)
    linked = {
        c: [linking_number(vertices[best[c]], off[best[b]]) for b in basis] for c in order.tolist()
    }
    within = [c for c in order.tolist() if not any(linked[c])]
    found = _independent(within)
    return found if len(found) == genus else _independent(order.tolist())[:genus]


def _independent(classes: Sequence[int]) -> list[int]:
    """Those of the classes, as bits, that are no sum of some before them."""
    found: list[int] = []
    reduced: list[int] = []
    for one in classes:
        rest = one
        for other in reduced:
            rest = min(rest, rest ^ other)
        if rest:
            found.append(one)
            reduced.append(rest)
    return found


def _opened(vertices: np.ndarray, faces: np.ndarray, loops: Sequence[np.ndarray]) -> Opened | None:
    """A mesh cut along closed curves and capped; None if they meet, or leave another topology."""
    if any(np.intersect1d(a, b).size for a, b in combinations(loops, 2)):
        return None
    edges = topology.edges_of(faces).pairs
    ends = np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=1) for loop in loops])
    is_cut = np.zeros(len(edges), dtype=bool)
    is_cut[topology.edges_between(edges, ends)] = True
    cut, origin = topology.cut_along(faces, is_cut)
    points, parts = [vertices[origin]], [cut]
    caps = len(origin) + np.arange(2 * len(loops))
    rims = topology.boundary_loops(cut)
    if len(rims) != len(caps) or topology.face_components(cut).max():
        return None
    rims.sort(key=lambda rim: [origin[rim[0]] in loop for loop in loops].index(True))
    for middle, rim in zip(caps.tolist(), rims, strict=True):
        points.append(vertices[origin[rim]].mean(axis=0, keepdims=True))
        parts.append(np.stack([np.roll(rim, -1), rim, np.full(len(rim), middle)], axis=1))
    origin = np.concatenate([origin, [origin[rim[0]] for rim in rims]])
    closed = np.concatenate(parts)
    if topology.euler_characteristic(closed) != 2:
        return None
    return Opened(np.concatenate(points), closed, origin, caps)
