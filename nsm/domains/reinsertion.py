"""Flipped triangles of a flat mesh removed by collapsing their vertices, and putting these back.

An edge collapse removes a vertex, and with it thin triangles that no descent turns: of corners
nearer to each other than single precision tells apart, or on one line. Once none of the triangles
that are left is flipped, the vertices come back in reverse order. Each finds a place without a
flip, because its star is seen from the vertex that it was drawn into: near that one there is
always room. The other vertices do not move.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nsm.domains.kernels import innermost
from nsm.domains.planar_mesh import cross, flipped
from nsm.domains.untangling import Copies, untangled
from nsm.domains.vertex_relaxation import Freedom, Stars, relax
from nsm.stages import at
from nsm.surfaces.predicates import orientation

_MOST = 5000  # vertices removed: it takes some milliseconds for each
_CROWD = 9  # neighbours of a vertex: with more, it is drawn into another rather
_ROOM = 1e-6  # of the area that a triangle should have: what a vertex leaves in its first place
_NEARER, _TRIES = 0.5, 30  # from a place towards the vertex that it was drawn into
_SWEEPS = 5
_MOST_SIDES = 24  # of a star whose innermost point is looked for


@dataclass
class _Removed:
    """A vertex, what it was drawn into, its corners (K, 2) as faces and numbers, and what stood
    there: signs (K,) and shifts (K, 2) of the image and of the mesh before it."""

    vertex: int
    target: int
    corners: np.ndarray
    sign: np.ndarray
    shift: np.ndarray


def reinserted(
    rest: np.ndarray,
    faces: np.ndarray,
    image: np.ndarray,
    fixed: np.ndarray,
    copies: Copies | None = None,
) -> np.ndarray:
    """The image of a flat mesh, with flipped triangles turned back where possible.

    Args:
        rest, faces, image, fixed, copies: as for :func:`nsm.domains.untangling.untangled`.

    Returns:
        (V, 2): ``image``, except for vertices of flipped triangles and others that had to be moved
        with them; ``image`` itself unless fewer triangles are flipped then.
    """
    image = np.array(image, dtype=np.float64)
    before = int(flipped(image, faces).sum())
    if not before:
        return image
    copies = Copies.none(len(image)) if copies is None else copies
    mesh = _Mesh(rest, faces, image, fixed, copies)
    at(f"{before} flips, their vertices taken out")
    removed = list(mesh.without_flips())
    moved = [one.vertex for one in reversed(removed) if mesh.put_back(one)]
    for _ in range(_SWEEPS):
        for v in moved:
            mesh.relax(v)
    found = copies.placed(mesh.place[:, 0])
    unmoved = np.ones(len(image), dtype=bool)
    unmoved[[one.vertex for one in removed]] = False
    unmoved = unmoved[copies.first]
    found[unmoved] = image[unmoved]
    return found if int(flipped(found, faces).sum()) < before else image


def turned_back(
    rest: np.ndarray,
    faces: np.ndarray,
    image: np.ndarray,
    fixed: np.ndarray,
    held: np.ndarray,
    copies: Copies | None = None,
) -> np.ndarray:
    """The image (V, 2) of a flat mesh with its flipped triangles turned back by either means.

    Args:
        rest, faces, image, fixed, copies: as for :func:`nsm.domains.untangling.untangled`.
        held: (V,) mask of vertices, such as landmarks, that move only if flips remain otherwise.
    """
    for stay in (fixed | held, fixed):
        image = untangled(rest, faces, image, stay, copies)
        mended = reinserted(rest, faces, image, stay, copies)
        if not flipped(mended, faces).any():
            break  # one that is mended in part only is no good start for a descent
    return mended


@dataclass(frozen=True)
class _Star:
    """The triangles around a vertex, all in its own lift.

    Attributes:
        face, corner: (K,) the triangles, and which of their corners the vertex is.
        b, c: (K,) their other corners, counter-clockwise.
        of_b, of_c: (K, 2, 2) where these are, in the image and before it.
    """

    face: np.ndarray
    corner: np.ndarray
    b: np.ndarray
    c: np.ndarray
    of_b: np.ndarray
    of_c: np.ndarray

    @property
    def is_closed(self) -> bool:
        """Whether the triangles go around the vertex once, from neighbour to neighbour."""
        ring = set(self.b.tolist())
        return len(ring) == len(self.b) and ring == set(self.c.tolist())

    def areas(self, here: np.ndarray, which: int) -> np.ndarray:
        """Twice the signed areas (K,) with the vertex at (2,), in the image (0) or before (1)."""
        return cross(self.of_b[:, which] - here, self.of_c[:, which] - here)

    def turned(self, here: np.ndarray) -> int:
        """How many triangles of the image are flipped with the vertex at (2,), exactly."""
        return int((orientation(here, self.of_b[:, 0], self.of_c[:, 0]) <= 0).sum())


class _Around(dict[int, set[int]]):
    """The faces around each of n vertices of a mesh (F, 3), looked up where they are asked for: of
    a large mesh few vertices are."""

    def __init__(self, faces: np.ndarray, n: int) -> None:
        super().__init__()
        corners = faces.ravel()
        self.corner = np.argsort(corners, kind="stable")
        self.start = np.searchsorted(corners[self.corner], np.arange(n + 1))

    def __missing__(self, v: int) -> set[int]:
        corners = self.corner[self.start[v] : self.start[v + 1]]
        found = self[v] = set((corners // 3).tolist())
        return found


class _Mesh:
    """A flat mesh that vertices are taken out of, with its copies drawn together.

    Corner k of face f is at sign[f, k] place[vertex[f, k]] + shift[f, k], in the image and before.
    """

    def __init__(
        self,
        rest: np.ndarray,
        faces: np.ndarray,
        image: np.ndarray,
        fixed: np.ndarray,
        copies: Copies,
    ) -> None:
        sign = copies.sign[:, None]
        before = rest - sign * rest[copies.first]
        self.place = np.stack([image, rest], axis=1)
        self.copies = copies
        self.vertex = copies.first[faces]
        self.sign = copies.sign[faces]
        self.shift = np.stack([copies.shift, before], axis=1)[faces]
        self.held = np.zeros(len(image), dtype=bool)
        self.held[copies.first[fixed]] = True
        self.around = _Around(self.vertex, len(image))
        self.bad = set(np.flatnonzero(flipped(image, faces)).tolist())

    def without_flips(self) -> Iterator[_Removed]:
        """Take vertices out, until no triangle is flipped or none can be taken out: those of
        flipped triangles, and where that does not help their neighbours."""
        queue: list[tuple[tuple[float, ...], int, int, int]] = []
        version = np.zeros(len(self.held), dtype=np.int64)

        def look(vertices: set[int]) -> None:
            for v in vertices:
                version[v] += 1
                if not self.held[v]:
                    for cost, w in self._options(v):
                        heapq.heappush(queue, (cost, v, w, int(version[v])))

        look(self._of_flips())
        count = 0
        while self.bad and count < _MOST:
            if not queue:
                around = set().union(*map(self._ring, self._of_flips()))
                look(around - self._of_flips())
                if not queue:
                    break
            _, v, w, of = heapq.heappop(queue)
            if of != version[v]:
                continue
            near = self._ring(v) | self._ring(w) | {w}
            yield self._drawn(v, w)
            version[[v, *near]] += 1
            count += 1
            look(self._of_flips() & near)

    def _of_flips(self) -> set[int]:
        """The vertices of flipped triangles."""
        return {v for f in self.bad for v in self.vertex[f].tolist()}

    def _ring(self, v: int) -> set[int]:
        return {u for f in self.around[v] for u in self.vertex[f].tolist()} - {v}

    def _star(self, v: int) -> _Star | None:
        """The triangles around a vertex; None where one has it twice."""
        face = np.array(sorted(self.around[v]), dtype=np.int64)
        is_here = self.vertex[face] == v
        if len(face) < 3 or (is_here.sum(axis=1) != 1).any():
            return None
        k = is_here.argmax(axis=1)
        kb, kc = (k + 1) % 3, (k + 2) % 3
        return _Star(
            face,
            k,
            self.vertex[face, kb],
            self.vertex[face, kc],
            self._seen(face, k, kb),
            self._seen(face, k, kc),
        )

    def _seen(self, face: np.ndarray, k: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Where other corners (K,) of faces are (K, 2, 2), in the lift of their corners k."""
        there = self.place[self.vertex[face, other]]
        there = self.sign[face, other, None, None] * there + self.shift[face, other]
        return np.asarray(self.sign[face, k, None, None] * (there - self.shift[face, k]))

    def _options(self, v: int) -> Iterator[tuple[tuple[float, ...], int]]:
        """The neighbours that a vertex may be drawn into, and what that costs: how many more
        triangles are flipped, how many before the map, and how flat they and how many meet."""
        star = self._star(v)
        if star is None or not star.is_closed:
            return
        ring = set(star.b.tolist())
        flips = len(self.bad & self.around[v])
        for w, here in zip(star.b.tolist(), star.of_b, strict=True):
            other = self._ring(w)
            common = ring & other
            if len(common) != 2 or any(len(self.around[u]) <= 3 for u in common):
                continue
            stay = (star.b != w) & (star.c != w)
            b, c = star.of_b[stay], star.of_c[stay]
            turned = [int((orientation(here[i], b[:, i], c[:, i]) <= 0).sum()) for i in range(2)]
            if turned[0] > flips:
                continue
            sides = np.stack([b[:, 0] - here[0], c[:, 0] - here[0], c[:, 0] - b[:, 0]])
            area = cross(sides[0], sides[1])
            shape = area / np.maximum((sides**2).sum(axis=2).max(axis=0), 1e-300)
            crowd = max(len(ring) + len(other) - 4, _CROWD) / _CROWD
            flat = crowd / max(float(shape.min(initial=1.0)), 1e-12)
            yield (turned[0] - flips, turned[1], flat), w

    def _drawn(self, v: int, w: int) -> _Removed:
        """Draw a vertex into a neighbour."""
        star = self._star(v)
        assert star is not None
        f, k = star.face, star.corner
        sign, shift = self.sign[f, k].copy(), self.shift[f, k].copy()
        one = int(np.flatnonzero(star.b == w)[0])
        g, kb = int(f[one]), (int(k[one]) + 1) % 3
        # where w is in the lift of v: a place(w) + d
        a = sign[one] * self.sign[g, kb]
        d = sign[one] * (self.shift[g, kb] - shift[one])
        self.vertex[f, k] = w
        self.sign[f, k] = sign * a
        self.shift[f, k] = sign[:, None, None] * d + shift
        corners = np.stack([f, k], axis=1)
        gone = self.around[v] & self.around[w]
        for h in gone:
            for u in set(self.vertex[h].tolist()) - {v}:
                self.around[u].discard(h)
        stay = np.array(sorted(self.around[v] - gone), dtype=np.int64)
        self.around[w].update(stay.tolist())
        self.bad -= self.around[v]
        here = (
            self.sign[stay][:, :, None] * self.place[self.vertex[stay], 0] + self.shift[stay, :, 0]
        )
        self.bad.update(stay[orientation(here[:, 0], here[:, 1], here[:, 2]) <= 0].tolist())
        self.around[v] = set()
        return _Removed(v, w, corners, sign, shift)

    def put_back(self, one: _Removed) -> bool:
        """Give a vertex its corners back, and a place where it flips no triangle if there is one:
        its own, or else the nearest to its place among its neighbours before the map. Whether it
        has moved."""
        f, k = one.corners.T
        v = one.vertex
        for h in f.tolist():
            for u in set(self.vertex[h].tolist()):
                self.around[u].discard(h)
        self.vertex[f, k], self.sign[f, k], self.shift[f, k] = v, one.sign, one.shift
        for h in f.tolist():
            for u in self.vertex[h].tolist():
                self.around[u].add(h)
        star = self._star(v)
        assert star is not None
        own, rest = self.place[v]
        size, now = star.areas(rest, 1), star.areas(own, 0)
        if (size > 0).all():
            least = _ROOM * size * max(float(now.sum()), 0.0) / float(size.sum())
            if (now > least).all() and not star.turned(own):
                return False
        for place in self._places(star, one.target, rest, size):
            place = self.copies.rounded(place[None])[0]
            if not star.turned(place):
                self.place[v, 0] = place
                return True
        return False

    def relax(self, v: int) -> None:
        """Move a vertex, by a step of Newton's method, to where its triangles are less distorted,
        but for the affine map that its neighbours follow."""
        star = self._star(v)
        assert star is not None
        own, rest = self.place[v]
        sides = star.of_c - star.of_b
        affine = np.linalg.lstsq(sides[:, 1], sides[:, 0], rcond=None)[0]
        if star.turned(own) or np.linalg.det(affine) <= 0:
            return
        flat = np.concatenate([rest[None], star.of_b[:, 1], star.of_c[:, 1]]) @ affine
        uv = np.concatenate([own[None], star.of_b[:, 0], star.of_c[:, 0]])
        n = len(star.b)
        b = 1 + np.arange(n)
        lifted = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
        with np.errstate(all="ignore"):
            stars = Stars.of(lifted, np.array([0]), np.zeros(n, dtype=np.int64), b, b + n)
            relax(uv, stars, Freedom.whole(len(uv)))
        here = self.copies.rounded(uv[:1])[0]
        if np.isfinite(here).all() and not star.turned(here):
            self.place[v, 0] = here

    def _places(
        self, star: _Star, target: int, rest: np.ndarray, size: np.ndarray
    ) -> Iterator[np.ndarray]:
        """Places (2,) for a vertex, the best first: as its neighbours were around it, innermost,
        and beside the vertex that it was drawn into."""
        inner = innermost(star.of_b[:, 0], star.of_c[:, 0]) if len(size) <= _MOST_SIDES else None
        if (size > 0).all():
            wanted = _mean_value(rest, star)
            yield wanted
            if inner is not None:
                for k in range(1, _TRIES):
                    yield inner + _NEARER**k * (wanted - inner)
        if inner is not None:
            yield inner
        sides = (star.of_c - star.of_b)[(star.b == target) | (star.c == target), 0]
        inwards = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
        lengths = np.linalg.norm(sides, axis=1)
        inwards = (inwards / np.maximum(lengths, 1e-300)[:, None]).sum(axis=0)
        here = star.of_b[star.b == target, 0][0]
        for k in range(1, _TRIES):
            yield here + _NEARER**k * lengths.min() * inwards


def _mean_value(here: np.ndarray, star: _Star) -> np.ndarray:
    """The mean (2,) of a star's ring in the image, with the mean value weights (Floater 2003) that
    its vertex at (2,) has before the map."""
    b, c = star.of_b[:, 1] - here, star.of_c[:, 1] - here
    lb, lc = np.linalg.norm(b, axis=1), np.linalg.norm(c, axis=1)
    half = np.abs(cross(b, c)) / np.maximum(lb * lc + (b * c).sum(axis=1), 1e-300)
    weight_b, weight_c = half / np.maximum(lb, 1e-300), half / np.maximum(lc, 1e-300)
    total = weight_b @ star.of_b[:, 0] + weight_c @ star.of_c[:, 0]
    return np.asarray(total / (weight_b.sum() + weight_c.sum()))
