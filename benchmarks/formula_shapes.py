"""Classes of shapes by formula, each in two poses and proportions, with known correspondences.

A solid is the smooth union of limbs (chains of capsules) and ellipsoids. Its surface is the zero
set of the distance, by marching cubes, on about 4,000 triangles. Landmarks are where rays from
within leave the solid, such as at the end of a limb, and correspond by their order.
``made(name, pose)`` gives one shape; ``symmetries`` the other orders in which landmarks correspond
as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from nsm.domains.orbifold.cones import decimated
from nsm.surfaces.topology import face_components, renumbered

FACES = 4000
CELLS = (110, 220)  # of marching cubes along the longest side; the second where that is coarse
X, Y, Z = np.eye(3)
Distance = Callable[[np.ndarray], np.ndarray]


class Shape(NamedTuple):
    """A mesh, and its landmarks (L,) as vertices: those that may be given, then the others."""

    vertices: np.ndarray
    faces: np.ndarray
    landmarks: np.ndarray
    given: int


class Solid:
    """A smooth union of parts, and the rays whose ends are landmarks."""

    def __init__(self, blend: float = 0.03) -> None:
        self.blend, self.parts, self.holes = blend, [], []  # type: ignore[var-annotated]
        self.given: list[Any] = []
        self.others: list[Any] = []

    def ball(self, centre: Any, radii: Any) -> None:
        """An ellipsoid along the axes."""
        c, r = np.asarray(centre, float), np.broadcast_to(radii, 3)
        self.parts.append(lambda p: (np.linalg.norm((p - c) / r, axis=1) - 1) * r.min())

    def box(self, centre: Any, half: Any) -> None:
        """A box along the axes."""
        c, h = np.asarray(centre, float), np.asarray(half, float)
        self.parts.append(lambda p: _outside_box(np.abs(p - c) - h))

    def ring(self, centre: Any, axis: int, radius: float, tube: float, stretch: float = 1) -> None:
        """A torus about an axis, stretched along x."""
        c, s = np.asarray(centre, float), np.array([stretch, 1, 1])

        def distance(p: np.ndarray) -> np.ndarray:
            q = (p - c) / s
            around = np.linalg.norm(np.delete(q, axis, axis=1), axis=1) - radius
            return np.hypot(around, q[:, axis]) - tube

        self.parts.append(distance)

    def limb(self, points: Any, radii: Any) -> np.ndarray:
        """Capsules from point to point; the direction of the last one."""
        x = np.asarray(points, float)
        r = np.broadcast_to(radii, len(x)).astype(float)
        for k in range(len(x) - 1):
            self.parts.append(_capsule(x[k], x[k + 1], r[k], r[k + 1]))
        return x[-1] - x[-2]

    def mark(self, origin: Any, direction: Any, given: bool = False) -> None:
        """A landmark: the end of a ray."""
        ray = np.asarray(origin, float), np.asarray(direction, float)
        (self.given if given else self.others).append(ray)

    def tip(self, points: Any, radii: Any, joint: Any = None, given: bool = True) -> None:
        """A limb whose end is a landmark; and so is, on the side ``joint``, its middle point."""
        x = np.asarray(points, float)
        self.mark(x[-1], self.limb(x, radii), given)
        if joint is not None:
            k = len(x) // 2
            along = x[k + 1] - x[k - 1] if len(x) > 2 else x[1] - x[0]
            along = along / np.linalg.norm(along)
            side = np.asarray(joint, float)
            self.mark(x[k], side - (side @ along) * along)

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Signed distances (N,), nearly."""
        least = np.full(len(p), np.inf)
        total = np.zeros(len(p))
        values = [part(p) for part in self.parts]
        for value in values:
            least = np.minimum(least, value)
        for value in values:
            total += np.exp((least - value) / self.blend)
        found = least - self.blend * np.log(total)
        for hole in self.holes:
            found = np.maximum(found, -hole(p))
        return found


def _outside_box(q: np.ndarray) -> np.ndarray:
    return np.linalg.norm(q.clip(min=0), axis=1) + q.max(axis=1).clip(max=0)


def _capsule(a: np.ndarray, b: np.ndarray, ra: float, rb: float) -> Distance:
    d = b - a

    def distance(p: np.ndarray) -> np.ndarray:
        t = ((p - a) @ d / (d @ d)).clip(0, 1)
        return np.linalg.norm(p - a - t[:, None] * d, axis=1) - ra - t * (rb - ra)

    return distance


def chain(start: Any, *steps: Any) -> np.ndarray:
    """Points from a start by steps."""
    return np.cumsum([start, *steps], axis=0)


def human(pose: int) -> Solid:
    s, long = Solid(0.02), (1.0, 1.25)[pose]
    s.limb([[0, 0.95, 0], [0, 1.2, 0], [0, 1.45, 0]], [0.16, 0.14, 0.17])
    s.limb([[0, 1.45, 0], [0, 1.65, 0]], 0.06)
    s.ball([0, 1.78, 0.01], [0.1, 0.14, 0.12])
    s.ball([0, 1.77, 0.13], [0.02, 0.03, 0.04])
    s.mark([0, 1.78, 0], Y, True), s.mark([0, 1.77, 0.13], Z, True)
    for side, lift in ((1, (-0.5, 0.9)[pose]), (-1, (-0.5, 0.2)[pose])):
        upper = long * 0.3 * np.array([side * np.cos(lift), np.sin(lift), 0.1])
        bend = lift + (0.1, 0.7)[pose]
        lower = long * 0.3 * np.array([side * np.cos(bend), np.sin(bend), 0.15])
        arm = chain([side * 0.18, 1.45, 0], upper, lower)
        s.tip(arm, [0.07, 0.05, 0.045], -Z)
        swing = (0.0, side * 0.6)[pose]
        thigh = long * 0.45 * np.array([0.1 * side, -np.cos(swing), np.sin(swing)])
        shin = long * 0.42 * np.array([0, -np.cos(swing - 0.3 * pose), np.sin(swing - 0.3 * pose)])
        leg = chain([side * 0.09, 0.9, 0], thigh, shin)
        s.limb(leg, [0.1, 0.065, 0.05])
        s.mark(leg[1], Z)
        s.tip([leg[-1], leg[-1] + [0.02 * side, -0.03, 0.17]], [0.05, 0.045])
    s.mark([0, 1.35, 0], Z, True), s.mark([0, 1.35, 0], -Z, True)
    s.mark([0, 1.05, 0], Z), s.mark([0, 1.05, 0], -Z)
    return s


def hand(pose: int) -> Solid:
    s, curl = Solid(0.02), (0.1, 0.4)[pose]
    s.ball([0, 0, 0], [0.42, 0.45, 0.16])
    s.tip([[0, -0.2, 0], [0, -0.8, 0]], [0.22, 0.2], Z)
    for k, (x, length) in enumerate(((-0.3, 0.75), (-0.1, 0.9), (0.1, 0.85), (0.3, 0.65))):
        fan, at, steps = (0.25, 0.2)[pose] * (k - 1.5), 0.0, []
        for share in (0.45, 0.3, 0.25):
            at += curl
            steps.append(
                length * share * np.array([np.sin(fan), np.cos(fan) * np.cos(at), np.sin(at)])
            )
        s.tip(chain([x, 0.35, 0], *steps), [0.1, 0.09, 0.085, 0.075], -Z)
    out = np.array([np.cos(0.6 + curl), np.sin(0.6 + curl), 0.4])
    s.tip(chain([0.3, -0.1, 0.03], 0.35 * out, 0.3 * (out + 0.4 * Y)), [0.13, 0.11, 0.09], -Z)
    s.mark([0, 0, 0], -Z, True), s.mark([0, 0, 0], Z)
    return s


def octopus(pose: int) -> Solid:
    s = Solid(0.03)
    s.limb([[0, 0, 0.1], [0, (0, 0.2)[pose], 0.7]], [0.3, 0.38])
    s.mark([0, (0, 0.2)[pose], 0.7], Z, True), s.mark([0, 0, 0.1], -Z)
    for k in range(8):
        angle = k * np.pi / 4
        out, bend = np.array([np.cos(angle), np.sin(angle), 0]), -0.5
        points = [0.2 * out]
        for j in range(5):
            bend += (0.25, 0.2 + 0.12 * np.sin(3 * k + j))[pose]
            points.append(points[-1] + 0.3 * (np.cos(bend) * out + np.sin(bend) * Z))
        s.tip(points, np.linspace(0.13, 0.045, 6), Z)
    return s


def ant(pose: int) -> Solid:
    s, abdomen = Solid(0.02), (0.34, 0.45)[pose]
    s.ball([0, 0.55, 0], [0.2, 0.22, 0.17]), s.ball([0, 0.1, 0], [0.13, 0.25, 0.13])
    s.ball([0, -0.25 - abdomen, 0.05], [0.24, abdomen, 0.22])
    s.limb([[0, 0.5, 0], [0, -0.5, 0]], 0.07)
    s.mark([0, -0.25 - abdomen, 0.05], -Y, True), s.mark([0, -0.5, 0.05], Z)
    s.mark([0, 0.1, 0], Z), s.mark([0, 0.55, 0], Z)
    for side in (1, -1):
        for k, turn in enumerate((0.6, 0.0, -0.6)):
            turn += (0, 0.25 * side * (-1) ** k)[pose]
            out = np.array([side * np.cos(turn), np.sin(turn), 0])
            leg = chain(
                [0.08 * side, 0.25 - 0.15 * k, 0], 0.35 * out + 0.2 * Z, 0.4 * out - 0.45 * Z
            )
            s.tip(leg, [0.05, 0.045, 0.035], Z)
        feeler = chain([0.08 * side, 0.7, 0.05], [0.15 * side, 0.2, 0.15], [0.05 * side, 0.3, 0])
        s.tip(feeler, [0.045, 0.04, 0.035], Z, given=False)
    return s


def teddy(pose: int) -> Solid:
    s, wide = Solid(0.04), (1.0, 1.2)[pose]
    s.ball([0, 0, 0], [0.42 * wide, 0.5, 0.38]), s.ball([0, 0.72, 0.02], [0.33, 0.3, 0.3])
    s.tip([[0, 0.68, 0.2], [0, 0.66, 0.33]], [0.13, 0.1])
    for side in (1, -1):
        s.tip([[0.2 * side, 0.9, 0], [0.29 * side, 1.02, 0]], 0.1)
        lift = (-0.2, 0.6 * side)[pose]
        arm = np.array([side * np.cos(lift), np.sin(lift), 0.2])
        s.tip(chain([0.3 * side, 0.25, 0], 0.25 * arm, 0.25 * arm), [0.15, 0.14, 0.13], -Z)
        out = np.array([0.35 * side, -0.6, (0.25, 0.7)[pose]])
        s.tip(chain([0.2 * side, -0.3, 0], 0.4 * out, 0.4 * out), [0.17, 0.16, 0.16], Y)
    s.mark([0, 0, 0], Z), s.mark([0, 0, 0], -Z), s.mark([0, 0.72, 0], -Z)
    return s


def chair(pose: int) -> Solid:
    s, tall, back = Solid(0.008), (0.45, 0.6)[pose], (0.55, 0.4)[pose]
    s.box([0, 0, 0], [0.25, 0.25, 0.03])
    s.box([0, -0.24, back / 2], [0.24, 0.025, back / 2])
    for x in (0.22, -0.22):
        for y in (0.22, -0.22):
            s.tip([[x, y, 0], [1.1 * x, 1.1 * y, -tall]], 0.03, [x, y, 0])
        s.mark([0.9 * x, -0.24, back - 0.03], [x, 0, 0.2], True), s.mark([x, 0, 0], [x, 0, 0])
    s.mark([0, 0.1, 0], Z, True), s.mark([0, 0, 0], -Z), s.mark([0, -0.24, back / 2], Y)
    return s


def table(pose: int) -> Solid:
    s, long = Solid(0.008), (0.5, 0.7)[pose]
    s.box([0, 0, 0], [long, 0.35, 0.03])
    for x in (long - 0.06, 0.06 - long):
        for y in (0.29, -0.29):
            s.tip([[x, y, 0], [x, y, (-0.5, -0.4)[pose]]], 0.035, [x, y, 0])
            s.mark([x, y, 0], [x, y, 0])
    s.mark([0, 0, 0], Z, True), s.mark([0, 0, 0], -Z, True)
    return s


def mug(pose: int) -> Solid:
    s, tall, wide = Solid(0.02), (0.5, 0.7)[pose], (0.4, 0.32)[pose]
    s.parts.append(_cylinder(wide, tall, 0))
    s.holes.append(_cylinder(wide - 0.07, tall, 0.12))
    handle = [wide + 0.25 * np.sin(a) for a in np.linspace(0, np.pi, 7)]
    height = 0.3 * tall * np.cos(np.linspace(0, np.pi, 7)) * 1.8
    points = np.stack([handle, np.zeros(7), height], axis=1) - [0.04, 0, 0]
    s.limb(points, 0.05)
    s.mark(points[3], X, True), s.mark(points[1], X), s.mark(points[5], X), s.mark(points[3], -X)
    for z, given in ((0, True), (-0.8, False)):
        for way in (-X, Y, -Y):
            s.mark((wide - 0.03) * way + [0, 0, z * tall], way, given)
    s.mark([0, 0, -tall + 0.06], -Z, True), s.mark([0, 0, -tall + 0.06], Z, True)
    return s


def _cylinder(radius: float, half: float, lift: float) -> Distance:
    """About z; its lower end is lifted, its upper one too."""
    return lambda p: _outside_box(
        np.stack(
            [np.hypot(p[:, 0], p[:, 1]) - radius, np.abs(p[:, 2] - lift) - half],
            axis=1,
        )
    )


def glasses(pose: int) -> Solid:
    s, stretch, fold = Solid(0.01), (1.0, 1.25)[pose], (0.0, 0.5)[pose]
    for side in (1, -1):
        c = np.array([0.3 * stretch * side, 0, 0])
        s.ring(c, 2, 0.22, 0.035, stretch)
        edge = c + [0.22 * stretch * side, 0.05, 0]
        arm = chain(
            edge,
            [0.04 * side, 0, -0.05],
            [-0.6 * np.sin(fold) * side, 0, -0.6 * np.cos(fold)],
            [0, -0.15, -0.1],
        )
        s.tip(arm, 0.03, Y)
        for way in (Y, -Y):
            s.mark(c + 0.22 * way, way, True)
        s.mark(c - [0.22 * stretch * side, 0, 0], Z)
        s.mark(c - 0.22 * Y, Z)
    s.limb([[-0.09 * stretch, 0.03, 0], [0, 0.06, 0.02], [0.09 * stretch, 0.03, 0]], 0.03)
    s.mark([0, 0.06, 0.02], Y, True), s.mark([0, 0.06, 0.02], -Y)
    return s


def fish(pose: int) -> Solid:
    s, deep = Solid(0.02), (0.28, 0.36)[pose]
    s.ball([0, 0, 0], [0.7, 0.14, deep])
    s.limb([[-0.5, 0, 0], [-0.8, (0, 0.1)[pose], 0]], [0.09, 0.06])
    tail = np.array([-0.8, (0, 0.1)[pose], 0])
    for way in (1, -1):
        s.tip([tail, tail + [-0.3, (0, 0.06)[pose], 0.28 * way]], [0.06, 0.035])
        s.tip([[0.2, 0.1 * way, -0.05], [0.05, 0.32 * way, -0.12]], [0.05, 0.035])
        s.mark([0.45, 0, 0.03], [0, way, 0])
        s.mark([-0.2, 0, 0], [0, way, 0])
    s.tip([[0.1, 0, deep - 0.05], [-0.15, 0, deep + 0.17]], [0.06, 0.035])
    s.mark([0, 0, 0], X, True), s.mark([0, 0, 0], -Z)
    return s


def pliers(pose: int) -> Solid:
    s, open_by = Solid(0.015), (0.15, 0.45)[pose]
    s.ball([0, 0, 0], [0.12, 0.12, 0.07])
    for side in (1, -1):
        up, down = side * open_by, side * (0.12 + 0.6 * open_by)
        way = np.array([np.sin(down), -np.cos(down), 0])
        handle = chain([0, 0, 0.02 * side], 0.35 * way + [0.06 * side, 0, 0], 0.6 * way)
        s.tip(handle, [0.07, 0.06, 0.055], [side, 0, 0])
        jaw = 0.3 * np.array([-np.sin(up), np.cos(up), 0])
        s.tip(chain([-0.05 * side, 0.02, -0.02 * side], 0.6 * jaw, 0.6 * jaw), [0.07, 0.06, 0.035])
        s.mark([0, 0, 0], side * Z, True)
        s.mark(handle[1], -side * X)
    return s


def bracket(pose: int) -> Solid:
    s, a, b = Solid(0.004), (0.6, 0.45)[pose], (0.45, 0.7)[pose]
    s.box([a / 2, 0, 0], [a / 2, 0.25, 0.05]), s.box([0.05, 0, b / 2], [0.05, 0.25, b / 2])
    s.box([0.15, 0.17, 0.15], [0.15, 0.03, 0.15])
    s.parts.append(lambda p: _cylinder(0.1, 0.12, 0.05)(p - [a - 0.2, 0, 0]))
    for y in (0.22, -0.22):
        s.mark([a - 0.05, y, 0], [1, np.sign(y), 0.01], True)
        s.mark([0.05, y, b - 0.05], [0.01, np.sign(y), 1], True)
        s.mark([0.05, y, 0], [-1, np.sign(y), -1], True)
        s.mark([0.05, y, b / 2], [0, y, 0])
    s.mark([a - 0.2, 0, 0.05], Z, True), s.mark([a - 0.2, 0, 0], -Z), s.mark([0.05, 0, b / 2], -X)
    s.mark([0.28, 0.17, 0.28], [1, 0, 1], True)
    return s


def snake(pose: int) -> Solid:
    s, t = Solid(0.01), np.linspace(0, 1, 40)
    if pose:
        angle, radius = 0.5 + 9 * t, 0.25 + 0.5 * t
        x = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.1 * t], axis=1)
    else:
        x = np.stack([3 * t, 0.3 * np.sin(9 * t), 0 * t], axis=1)
    r = 0.06 * np.minimum(1, 0.35 + 4 * (1 - t)) * np.minimum(1, 0.8 + 5 * t)
    s.limb(x, r)
    s.mark(x[0], x[0] - x[1], True), s.mark(x[-1], x[-1] - x[-2], True)
    for k in range(4, 40, 4):
        s.mark(x[k], Z, k % 8 == 0), s.mark(x[k], -Z)
    return s


def ray(pose: int) -> Solid:
    s, wide = Solid(0.012), (0.9, 0.65)[pose]
    s.ball([0, 0, 0], [wide, 0.55, 0.045]), s.ball([0, 0.05, 0.02], [0.25, 0.4, 0.09])
    s.tip([[0, -0.45, 0], [(0, 0.2)[pose], -1.3, 0]], [0.05, 0.025], Z)
    for side in (1, -1):
        s.tip([[0.13 * side, 0.3, 0.05], [0.13 * side, 0.33, 0.1]], 0.04)
        s.mark([0, 0, 0], [side, 0, 0], True), s.mark([0.5 * wide * side, 0, 0], Z)
        s.mark([0.5 * wide * side, 0, 0], -Z)
    s.mark([0, 0, 0], Y, True), s.mark([0, 0, 0], -Z, True)
    return s


def vase(pose: int) -> Solid:
    s = Solid(0.02)
    radii = ((0.25, 0.45, 0.4, 0.2, 0.25), (0.3, 0.36, 0.5, 0.16, 0.22))[pose]
    for k in range(4):
        s.limb([[0, 0, 0.3 * k], [0, 0, 0.3 * k + 0.3]], radii[k : k + 2])
    s.tip([[0.3, 0, 0.35], [0.62, 0, 0.62], [0.66, 0, 0.7]], [0.1, 0.06, 0.05], -X)
    for z in (0.3, 0.6, 0.95):
        for way in (Y, -Y, -X):
            s.mark([0, 0, z], way, z != 0.6)
    s.mark([0, 0, 0], -Z, True)
    return s


CLOSED = dict(
    human=human, hand=hand, octopus=octopus, ant=ant, teddy=teddy, chair=chair, table=table,
    mug=mug, glasses=glasses, fish=fish, pliers=pliers, bracket=bracket, snake=snake, ray=ray,
)  # fmt: skip
# open along its rim, and with a hole in its side
OPEN: dict[str, Callable[[int], Solid]] = {"vase": vase}
NAMES = (*CLOSED, *OPEN, "face")
# rotations that take the first pose to itself, by axis and order; limbs bend in the second one
ROTATIONS = {"octopus": (Z, 8), "table": (Z, 2), "pliers": (Y, 2)}


def made(name: str, pose: int, faces: int = FACES) -> Shape:
    """A shape of a class in one of two poses."""
    if name == "face":
        return _face(pose, faces)
    solid = {**CLOSED, **OPEN}[name](pose)
    x, triangles = _zero_set(solid, CELLS[0])
    if len(triangles) < 2 * faces:
        x, triangles = _zero_set(solid, CELLS[1])
    if name in OPEN:
        middle = x[triangles].mean(axis=1)
        hole = np.linalg.norm(middle - [-0.2, (0.3, 0.25)[pose], 0.45], axis=1) < 0.18
        triangles = triangles[(middle[:, 2] < 1.25) & ~hole]
        label = face_components(triangles)
        triangles = triangles[label == np.bincount(label).argmax()]
        used, local = renumbered(triangles, len(x))
        x, triangles = x[used], local[triangles]
    ends = np.array([_end(solid, *ray) for ray in (*solid.given, *solid.others)])
    return _finished(x, triangles, ends, len(solid.given), faces)


def symmetries(name: str) -> list[np.ndarray]:
    """Orders (L,) of the landmarks of a class, one for each rotation of the first pose to itself;
    the order in which they are comes first."""
    shape = made(name, 0)
    places = shape.vertices[shape.landmarks]
    axis, order = ROTATIONS.get(name, (Z, 1))
    return [
        np.linalg.norm(
            Rotation.from_rotvec(2 * np.pi * k / order * axis).apply(places)[:, None] - places,
            axis=2,
        ).argmin(axis=1)
        for k in range(order)
    ]


def _zero_set(solid: Distance, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a solid's surface, the largest part."""
    span = np.linspace(-4, 4, 81)
    rough = np.stack(np.meshgrid(span, span, span, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = rough[solid(rough) < 0.15]
    low, high = inside.min(axis=0) - 0.1, inside.max(axis=0) + 0.1
    size = (high - low).max() / cells
    axes = [np.arange(a, b + size, size) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points = np.ascontiguousarray(grid.transpose(2, 1, 0, 3).reshape(-1, 3))
    values = np.concatenate([solid(part) for part in np.array_split(points, 40)])
    x, triangles, _ = igl.marching_cubes(values, points, *grid.shape[:3], 0.0)
    label = face_components(triangles)
    triangles = triangles[label == np.bincount(label).argmax()]
    used, local = renumbered(triangles, len(x))
    x, triangles = x[used], local[triangles]
    a, b, c = x[triangles].transpose(1, 0, 2)
    if (a * np.cross(b, c)).sum() < 0:
        triangles = triangles[:, ::-1]
    return x, np.ascontiguousarray(triangles)


def _end(solid: Distance, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Where a ray from within leaves the solid."""
    along = direction / np.linalg.norm(direction)
    ways = np.linspace(0, 1.5, 3001)
    outside = solid(origin + ways[:, None] * along) > 0
    assert not outside[0] and outside.any(), "the ray begins outside"
    return np.asarray(origin + ways[outside.argmax()] * along)


def _finished(
    x: np.ndarray, triangles: np.ndarray, ends: np.ndarray, given: int, faces: int
) -> Shape:
    marks = np.linalg.norm(x[:, None] - ends, axis=2).argmin(axis=0)
    coarse, kept = decimated(x, triangles, faces, marks)
    return Shape(x[kept], coarse, np.searchsorted(kept, marks), given)


def _face(pose: int, faces: int) -> Shape:
    """The front of a head, over an ellipse."""
    n = 64
    u, v = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    ids = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    # a square onto a disc
    disc = np.stack([u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)], axis=-1).reshape(-1, 2)

    def height(p: np.ndarray) -> np.ndarray:
        q, nose = p / [0.75, 1], (0.22, 0.35)[pose]

        def bump(x: float, y: float, w: float, h: float) -> np.ndarray:
            return np.exp(-(((q[:, 0] - x) / w) ** 2) - ((q[:, 1] - y) / h) ** 2)

        z = 0.9 * np.sqrt(1.1 - (q**2).sum(axis=1)) + nose * bump(0, -0.08, 0.11, 0.2)
        z -= 0.1 * (bump(0.35, 0.2, 0.15, 0.1) + bump(-0.35, 0.2, 0.15, 0.1))
        z += 0.06 * bump(0, -0.45, 0.25, 0.05) + (0.05, 0.15)[pose] * bump(0, -0.75, 0.15, 0.1)
        return np.asarray(z)

    def lifted(p: np.ndarray) -> np.ndarray:
        return np.column_stack([p, height(p)])

    wide = (0.75, 0.85)[pose]
    marks = [(0, -0.1), (0.35, 0.2), (-0.35, 0.2), (0, -0.45), (0, -0.75), (0, 0.5)]
    others = [(0, 0.15), (0.25, -0.45), (-0.25, -0.45), (0.5, -0.1), (-0.5, -0.1), (0.4, 0.5)]
    scale = np.array([0.75, 1])
    wider = np.array([wide / 0.75, 1, 1])
    ends = lifted(np.array([*marks, *others]) * scale) * wider
    return _finished(lifted(disc * scale) * wider, triangles, ends, len(marks), faces)
