"""Close the boundaries of a part of a shape by caps of a wanted area.

A map of a part into a whole shape leaves the rest of that shape to the caps. So they are as large
as what is missing: parts of spheres that stand on the boundary loops, with triangles that grow away
from these. Where a cap crosses the part in space does no harm: a layout sees its edges alone.
"""

from __future__ import annotations

import numpy as np

from nsm.surfaces import topology
from nsm.wording import number_of

_TRIANGLES = 3000  # of a large cap, about
_GROWTH = 1.3  # of the edges from ring to ring
_FEWEST = 5  # vertices of a ring, and steps from a loop to the middle of its cap
_NARROW = 0.2  # of the radius that a loop's length gives: the least that its shape is taken to have
_CORRECTIONS, _EXACT = 6, 0.01  # of a cap's area, which a loop that is not round makes larger
_FADE = 0.5  # of the way to the middle: the loop's own shape is seen in the rings up to there


def capped(
    vertices: np.ndarray, faces: np.ndarray, area: float
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Close all boundaries of a mesh.

    Each triangle of a cap has a new vertex at a corner.

    Args:
        vertices: (V, 3).
        faces: (F, 3), oriented and manifold.
        area: that the closed mesh is to have. The caps share what is missing in proportion to
            the squares of their loops' lengths; flat ones have the least.

    Returns:
        Vertices (V + K, 3), the K inserted ones last; faces, those of the caps last; a log line,
        or none where the mesh is closed.
    """
    loops = topology.boundary_loops(faces)
    if not loops:
        return vertices, faces, []
    missing = area - float(topology.face_areas(vertices, faces).sum())
    lengths = np.array(
        [np.linalg.norm(vertices[p] - vertices[np.roll(p, -1)], axis=1).sum() for p in loops]
    )
    share = lengths**2 / (lengths**2).sum()
    points, triangles = [vertices], [faces]
    for loop, part in zip(loops, share, strict=True):
        own, corners = _of_area(vertices[loop], part * missing)
        first = sum(map(len, points))
        number = np.concatenate([loop, first + np.arange(len(own))])
        points.append(own)
        triangles.append(number[corners])
    whole, every = np.concatenate(points), np.concatenate(triangles)
    areas = topology.face_areas(whole, every)
    percent = 100 * float(areas[len(faces) :].sum() / areas.sum())
    sizes = ", ".join(str(len(loop)) for loop in loops[:8]) + (", ..." if len(loops) > 8 else "")
    line = (
        f"{number_of(len(loops), 'boundary')} of {sizes} edges closed by caps for the map, which "
        f"have {percent:.0f} % of the area; left out of figures and exported meshes"
    )
    return whole, every, [line]


def _of_area(loop: np.ndarray, area: float) -> tuple[np.ndarray, np.ndarray]:
    """The cap of an area, as :func:`_cap` has it, or the flat one if that is larger."""
    found, wanted = _cap(loop, area), area
    for _ in range(_CORRECTIONS):
        points, corners = found
        off = area - float(topology.face_areas(np.concatenate([loop, points]), corners).sum())
        if abs(off) < _EXACT * area or wanted + off <= 0:
            break
        wanted += off
        found = _cap(loop, wanted)
    return found


def _cap(loop: np.ndarray, area: float) -> tuple[np.ndarray, np.ndarray]:
    """A cap over a boundary loop (B, 3), in the direction of the mesh's faces.

    It has about the given area; more, if the loop is not round.

    Returns:
        its inner vertices (K, 3), and faces of numbers among the loop's vertices and then these.
    """
    sides = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    length = float(sides.sum())
    middle = loop.mean(axis=0)
    around = 0.5 * np.cross(loop - middle, np.roll(loop, -1, axis=0) - middle).sum(axis=0)
    radius = max(float(np.sqrt(np.linalg.norm(around) / np.pi)), _NARROW * length / (2 * np.pi))
    axes = _axes(around)
    # the loop winds around ``around``; the mesh lies to its left, so that the cap goes down
    height = float(np.sqrt(max(area / np.pi - radius**2, 0.0)))
    profile = _Profile(radius, height)
    edge = float(np.median(sides))
    largest = max(np.sqrt(max(area, np.pi * radius**2) / (0.433 * _TRIANGLES)), 1e-300)

    angle = 2 * np.pi * np.concatenate([[0.0], np.cumsum(sides)[:-1]]) / length
    flat = (loop - middle) @ axes.T
    phase = np.angle(((flat[:, 0] + 1j * flat[:, 1]) * np.exp(-1j * angle)).sum())
    own = flat - _circle(angle + phase, radius, 0.0)

    places = profile.steps(edge, largest)
    angles, points = [angle], []
    for along, step in places:
        ring, down = profile.at(along)
        count = max(_FEWEST, round(2 * np.pi * ring / step))
        at = 2 * np.pi * np.arange(count) / count
        fade = max(0.0, 1 - along / (_FADE * profile.length)) ** 2
        shape = np.stack([np.interp(at, angle, x, period=2 * np.pi) for x in own.T], axis=1)
        points.append(middle + (_circle(at + phase, ring, -down) + fade * shape) @ axes)
        angles.append(at)
    points.append(middle + np.array([[0.0, 0.0, -profile.at(profile.length)[1]]]) @ axes)
    first = np.cumsum([0, *map(len, angles)])
    rings = [
        _between(a, b, n, m)
        for a, b, n, m in zip(angles, angles[1:], first, first[1:], strict=False)
    ]
    last = first[-2] + np.arange(len(angles[-1]))
    top = np.stack([np.roll(last, -1), last, np.full(len(last), first[-1])], axis=1)
    return np.concatenate(points), np.concatenate([*rings, top])


class _Profile:
    """The way from the rim of a part of a sphere to its middle.

    Args:
        radius, height: of the part; height 0 is a flat disc.
    """

    def __init__(self, radius: float, height: float) -> None:
        self.radius = radius
        self.opening = 2 * np.arctan2(height, radius)
        flat = self.opening < 1e-3
        self.sphere = np.inf if flat else radius / np.sin(self.opening)
        self.length = radius if flat else self.sphere * self.opening

    def at(self, along: float) -> tuple[float, float]:
        """Distance from the axis, and how far down, at a length from the rim."""
        if not np.isfinite(self.sphere):
            return self.radius - along, 0.0
        left = self.opening - along / self.sphere
        return (
            float(self.sphere * np.sin(left)),
            float(self.sphere * (np.cos(left) - np.cos(self.opening))),
        )

    def steps(self, edge: float, largest: float) -> list[tuple[float, float]]:
        """Where the rings are, and the length of the edges there: from ``edge``, growing."""
        longest = self.length / _FEWEST
        step, along = min(edge, longest), 0.0
        found: list[tuple[float, float]] = []
        while True:
            along += step
            if along > self.length - 0.75 * step:
                return found
            found.append((along, step))
            step = min(max(step, min(step * _GROWTH, largest)), longest)


def _axes(around: np.ndarray) -> np.ndarray:
    """A right-handed frame (3, 3), in rows, whose third axis has the direction of a vector (3,)."""
    size = float(np.linalg.norm(around))
    third = around / size if size > 0 else np.array([0.0, 0.0, 1.0])
    first = np.cross(np.eye(3)[int(np.abs(third).argmin())], third)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(third, first), third])


def _circle(angle: np.ndarray, radius: float, height: float) -> np.ndarray:
    """Points (N, 3) of a circle around the third axis."""
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(len(angle), height)], axis=1
    )


def _between(outer: np.ndarray, inner: np.ndarray, first: int, then: int) -> np.ndarray:
    """Triangles (N + M, 3) between two rings of vertices at rising angles (N,) and (M,), which
    begin at 0; their numbers begin with ``first`` and ``then``."""
    turn = 2 * np.pi
    a, b = [*outer, turn], [*inner, turn]
    i = j = 0
    found = []
    while i < len(outer) or j < len(inner):
        here, there = first + i % len(outer), then + j % len(inner)
        if j == len(inner) or (i < len(outer) and a[i + 1] + a[i] <= b[j + 1] + b[j]):
            i += 1
            found.append((first + i % len(outer), here, there))
        else:
            j += 1
            found.append((here, there, then + j % len(inner)))
    return np.array(found, dtype=np.int64)
