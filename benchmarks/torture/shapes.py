"""Difficult surfaces, one function each: vertices (V, 3) and triangles (F, 3).

Nothing here uses nsm, so that an error of nsm cannot affect the input.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]

SOLVED, REFUSED = "solved", "refused"


@dataclass(frozen=True)
class Shape:
    """A mesh, the expected outcome, and a part of the message of a refusal."""

    group: str
    make: Callable[[], Mesh]
    expected: str = SOLVED
    reason: str = ""


# ------------------------------------------------------------------ building blocks


def grid(rows: int, columns: int, *, wrap_rows: bool = False, wrap_columns: bool = False) -> Mesh:
    """Points (i, j, 0) of a grid, and its triangles; a wrapped direction is periodic."""
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    points = np.stack([i, j, np.zeros_like(i)], axis=-1).reshape(-1, 3).astype(float)
    a, b = np.meshgrid(
        np.arange(rows if wrap_rows else rows - 1),
        np.arange(columns if wrap_columns else columns - 1),
        indexing="ij",
    )
    a, b = a.ravel(), b.ravel()
    corner = [
        ((a + da) % rows) * columns + (b + db) % columns
        for da, db in ((0, 0), (1, 0), (1, 1), (0, 1))
    ]
    faces = np.concatenate([np.stack(corner[:3], 1), np.stack([corner[0], *corner[2:]], 1)])
    return points, faces


def bumpy(n: int = 24) -> Mesh:
    """A height field over the unit square."""
    points, faces = grid(n, n)
    points /= n - 1
    points[:, 2] = 0.1 * np.sin(5 * points[:, 0]) * np.cos(4 * points[:, 1])
    return points, faces


def ball(n: int = 16, radius: float = 1.0) -> Mesh:
    """A sphere of rings with a triangle fan at each pole, oriented outwards."""
    rings, around = n, 2 * n
    polar = np.pi * np.arange(1, rings) / rings
    angle = 2 * np.pi * np.arange(around) / around
    p, a = np.meshgrid(polar, angle, indexing="ij")
    points = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1).reshape(-1, 3)
    faces = grid(rings - 1, around, wrap_columns=True)[1]
    south, north = len(points), len(points) + 1
    last = (rings - 2) * around
    k = np.arange(around)
    top = np.stack([k, (k + 1) % around, np.full(around, north)], 1)
    bottom = np.stack([last + (k + 1) % around, last + k, np.full(around, south)], 1)
    points = np.vstack([points, [[0, 0, -1.0], [0, 0, 1.0]]])
    return radius * points, np.vstack([faces, top, bottom])


def torus(n: int = 24, tube: float = 0.4) -> Mesh:
    """A torus about the z axis."""
    points, faces = grid(n, 2 * n, wrap_rows=True, wrap_columns=True)
    small, large = 2 * np.pi * points[:, 0] / n, np.pi * points[:, 1] / n
    reach = 1 + tube * np.cos(small)
    return np.stack([reach * np.cos(large), reach * np.sin(large), tube * np.sin(small)], 1), faces


def joined(meshes: Iterable[Mesh]) -> Mesh:
    """The union of meshes, without connecting them."""
    points, faces, count = [], [], 0
    for p, f in meshes:
        points.append(p)
        faces.append(f + count)
        count += len(p)
    return np.vstack(points), np.vstack(faces)


def without(mesh: Mesh, faces: np.ndarray) -> Mesh:
    """The mesh without some faces."""
    return mesh[0], np.delete(mesh[1], faces, axis=0)


def voxels(filled: np.ndarray) -> Mesh:
    """The boundary of a solid of unit cubes: quads in two triangles, vertices shared."""
    directions = [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)]
    padded = np.pad(filled, 1)
    quads = []
    for axis, sign in directions:
        beyond = np.roll(padded, -sign, axis)
        cells = np.argwhere(padded & ~beyond)
        u, v = [k for k in range(3) if k != axis]
        base = cells.copy()
        base[:, axis] += int(sign > 0)
        ring = []
        order = ((0, 0), (1, 0), (1, 1), (0, 1))
        # counter-clockwise seen from outside: axis, u, v are right-handed for axes 0 and 2
        turned = (sign > 0) == (axis != 1)
        for du, dv in order if turned else order[::-1]:
            corner = base.copy()
            corner[:, u] += du
            corner[:, v] += dv
            ring.append(corner)
        quads.append(np.stack(ring, axis=1))
    corners = np.concatenate(quads).reshape(-1, 3)
    points, index = np.unique(corners, axis=0, return_inverse=True)
    q = index.reshape(-1, 4)
    return points.astype(float), np.vstack([q[:, :3], q[:, [0, 2, 3]]])


# ------------------------------------------------------------------ degenerate triangles


def stretched(ratio: float) -> Mesh:
    """A grid of triangles ``ratio`` times as long as wide."""
    points, faces = bumpy()
    return points * [1.0, 1 / ratio, 1.0 / ratio], faces


def needles(gap: float) -> Mesh:
    """A sphere with each triangle split at a point ``gap`` away from a side."""
    points, faces = ball(8)
    a, b, c = (points[faces[:, k]] for k in range(3))
    middle = (0.5 - gap) * a + (0.5 - gap) * b + 2 * gap * c
    new = len(points) + np.arange(len(faces))
    split = [np.stack([faces[:, i], faces[:, j], new], 1) for i, j in ((0, 1), (1, 2), (2, 0))]
    return np.vstack([points, middle]), np.vstack(split)


def caps() -> Mesh:
    """A plate with random vertices: slivers of every kind."""
    points, faces = bumpy(20)
    random = np.random.default_rng(1)
    inner = (points[:, :2] > 0.01).all(1) & (points[:, :2] < 0.99).all(1)
    points[inner, :2] += 0.499 / 19 * random.uniform(-1, 1, (int(inner.sum()), 2))
    return points, faces


def zero_area() -> Mesh:
    """A plate with degenerate triangles: edges subdivided on one side only."""
    points, faces = bumpy(12)
    random = np.random.default_rng(2)
    for f in random.choice(len(faces), 30, replace=False):
        a, b, c = faces[f]
        points = np.vstack([points, 0.5 * (points[a] + points[b])])
        m = len(points) - 1
        faces[f] = (a, m, c)
        faces = np.vstack([faces, [(m, b, c), (a, b, m)]])
    return points, faces


def short_edges(length: float) -> Mesh:
    """A sphere with some vertices split in two, ``length`` apart."""
    points, faces = ball(10)
    for v in range(25, 175, 25):
        around = np.flatnonzero((faces == v).any(axis=1))
        ring = {}
        for f in around:
            k = int(np.flatnonzero(faces[f] == v)[0])
            ring[int(faces[f, (k + 1) % 3])] = (int(faces[f, (k + 2) % 3]), f)
        start = min(ring)
        new = len(points)
        points = np.vstack([points, points[v] + length * np.array([0.6, 0.8, 0.0])])
        vertex = start
        for _ in range(3):  # half of the fan goes to the new vertex
            following, f = ring[vertex]
            faces[f][faces[f] == v] = new
            vertex = following
        faces = np.vstack([faces, [(v, start, new), (new, vertex, v)]])
    return points, faces


def spike(height: float) -> Mesh:
    """A sphere with one vertex far outside."""
    points, faces = ball(12)
    points[len(points) // 2] *= height
    return points, faces


# ------------------------------------------------------------------ size and place


def moved(mesh: Callable[[], Mesh], scale: float = 1.0, shift: float = 0.0) -> Mesh:
    points, faces = mesh()
    return points * scale + shift * np.array([1.0, -1.0, 0.5]), faces


# ------------------------------------------------------------------ duplicate and flipped faces


def doubled() -> Mesh:
    """Each tenth face three times, once with its corners in another order."""
    points, faces = ball()
    return points, np.vstack([faces, faces[::10], faces[::10][:, [1, 2, 0]]])


def both_ways() -> Mesh:
    """Each face and its mirror image."""
    points, faces = bumpy()
    return points, np.vstack([faces, faces[:, ::-1]])


def turned(share: float) -> Mesh:
    """A torus with a share of its faces flipped."""
    points, faces = torus()
    random = np.random.default_rng(3)
    some = random.random(len(faces)) < share
    faces[some] = faces[some][:, ::-1]
    return points, faces


def isolated() -> Mesh:
    """A plate with unreferenced vertices and faces that are an edge or a point."""
    points, faces = bumpy()
    points = np.vstack([points, [[3.0, 3, 3], [4, 4, 4]]])
    n = len(points)
    return points, np.vstack([faces, [(n - 1, n - 2, n - 1), (0, 5, 0), (7, 7, 7)]])


# ------------------------------------------------------------------ non-orientable, non-manifold


def moebius(n: int = 60) -> Mesh:
    angle = 2 * np.pi * np.arange(n) / n
    rows = []
    for side in (-0.3, 0.0, 0.3):
        reach = 1 + side * np.cos(angle / 2)
        rows.append([reach * np.cos(angle), reach * np.sin(angle), side * np.sin(angle / 2)])
    points = np.transpose(rows, (0, 2, 1)).reshape(-1, 3)
    faces = []
    for k in range(n):
        for row in (0, 1):
            last = k == n - 1
            a, b = row * n + k, (row + 1) * n + k
            c = (2 - row) * n if last else a + 1
            d = (1 - row) * n if last else b + 1
            faces += [(a, c, b), (b, c, d)]
    return points, np.array(faces)


def klein(n: int = 40) -> Mesh:
    """A Klein bottle (the figure-eight immersion)."""
    points, faces = grid(n, n, wrap_columns=True)
    u, v = 2 * np.pi * points[:, 0] / n, 2 * np.pi * points[:, 1] / n
    reach = 2 + np.cos(u / 2) * np.sin(v) - np.sin(u / 2) * np.sin(2 * v)
    height = np.sin(u / 2) * np.sin(v) + np.cos(u / 2) * np.sin(2 * v)
    seam = []
    k = np.arange(n)
    first, last = (-k) % n, (n - 1) * n + k  # at u = 2π, v runs the other way
    nxt, nxt_last = (-(k + 1)) % n, (n - 1) * n + (k + 1) % n
    seam = [np.stack([last, first, nxt], 1), np.stack([last, nxt, nxt_last], 1)]
    return np.stack([reach * np.cos(u), reach * np.sin(u), height], 1), np.vstack([faces, *seam])


def projective_plane() -> Mesh:
    """The real projective plane with six vertices; it intersects itself."""
    points = np.random.default_rng(4).normal(size=(6, 3))
    faces = [
        (0, 1, 4), (0, 1, 5), (0, 2, 3), (0, 2, 5), (0, 3, 4),
        (1, 2, 3), (1, 2, 4), (1, 3, 5), (2, 4, 5), (3, 4, 5),
    ]  # fmt: skip
    return points, np.array(faces)


def book(pages: int) -> Mesh:
    """Triangles that share one edge."""
    angle = 2 * np.pi * np.arange(pages) / pages
    tips = np.stack([np.cos(angle), np.sin(angle), np.full(pages, 0.5)], 1)
    points = np.vstack([[[0.0, 0, 0], [0, 0, 1]], tips])
    return points, np.array([(0, 1, 2 + k) for k in range(pages)])


def touching_balls() -> Mesh:
    """Two spheres that share one vertex."""
    (p, f), (q, g) = ball(8), ball(8)
    q = q + [0, 0, 2.0]
    south = len(q) - 2
    g = g + len(p)
    g[g == south + len(p)] = len(p) - 1
    return np.vstack([p, q]), np.vstack([f, g])


def pinched_torus() -> Mesh:
    """A torus with two far vertices merged."""
    points, faces = torus()
    faces[faces == len(points) // 2] = 0
    return points, faces


def chessboard() -> Mesh:
    """A plate without its black squares: the white ones are connected only by corners."""
    points, faces = bumpy(13)
    cells = np.arange(144)
    black = (cells // 12 + cells % 12) % 2 == 1
    return without((points, faces), np.flatnonzero(np.tile(black, 2)))


# ------------------------------------------------------------------ boundary loops and handles


def holes(count: int, n: int = 36) -> Mesh:
    """A plate with count - 1 holes, that is, count boundary loops."""
    points, faces = bumpy(n)
    side = int(np.ceil(np.sqrt(max(count - 1, 1))))
    step = (n - 1) / (side + 1)
    places = [
        (round(step * (k // side + 1)), round(step * (k % side + 1))) for k in range(count - 1)
    ]
    cut = np.array([a * (n - 1) + b for a, b in places], dtype=int)
    return without((points, faces), np.concatenate([cut, cut + (n - 1) ** 2]).astype(int))


def ball_with_pinholes(count: int) -> Mesh:
    """A sphere without single triangles: boundary loops of three edges."""
    points, faces = ball(24)
    return without((points, faces), np.linspace(0, len(faces) - 1, count).astype(int))


def handles(genus: int) -> Mesh:
    """A slab of cubes with ``genus`` shafts."""
    solid = np.ones((4 * genus + 3, 7, 3), dtype=bool)
    for k in range(genus):
        solid[4 * k + 2 : 4 * k + 5, 2:5, :] = False
    points, faces = voxels(solid)
    return points, faces


def handles_and_holes() -> Mesh:
    """Genus two with three boundary loops."""
    points, faces = handles(2)
    return without((points, faces), np.array([0, 40, 90]))


# ------------------------------------------------------------------ connected components


def parts(count: int, size: float) -> Mesh:
    """A sphere, and count - 1 more of the given size."""
    small = [(size * p + [3 * (k + 1), 0, 0], f) for k in range(count - 1) for p, f in [ball(5)]]
    return joined([ball(16), *small])


# ------------------------------------------------------------------ few faces, unusual shapes


def one_triangle() -> Mesh:
    return np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 2]]), np.array([[0, 1, 2]])


def two_triangles() -> Mesh:
    return np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.3], [0, 1, 0]]), np.array(
        [[0, 1, 2], [0, 2, 3]]
    )


def fan(count: int, whole: bool = False) -> Mesh:
    """Triangles around one vertex; if not whole, it is on the boundary."""
    angle = (2 if whole else 1.7) * np.pi * np.arange(count + (not whole)) / count
    outer = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.cos(3 * angle)], 1)
    k = np.arange(count)
    return np.vstack([[[0.0, 0, 0]], outer]), np.stack(
        [np.zeros(count, int), 1 + k, 1 + (k + 1) % len(outer)], 1
    )


def strip(count: int) -> Mesh:
    """A strip of triangles with all vertices on the boundary."""
    points, faces = grid(count + 1, 2)
    angle = 0.2 * points[:, 0]
    radius = 5 + 0.15 * angle + points[:, 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.1 * angle], 1), faces


def tetrahedron() -> Mesh:
    return (
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
    )


def pillow() -> Mesh:
    """Two triangles that share all three edges: closed, without volume."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    return points, np.array([[0, 1, 2], [0, 2, 1]])


def cube() -> Mesh:
    return voxels(np.ones((1, 1, 1), dtype=bool))


def tube(length: int) -> Mesh:
    """A closed tube of hexagons, ``length`` circumferences long."""
    points, faces = grid(6 * length, 6, wrap_columns=True)
    angle = 2 * np.pi * points[:, 1] / 6
    p = np.stack([np.cos(angle), np.sin(angle), points[:, 0]], 1)
    ends = np.array([[0, 0, -0.5], [0, 0, 6 * length - 0.5]])
    k = np.arange(6)
    n, last = len(p), len(p) - 6
    top = np.stack([k, (k + 1) % 6, np.full(6, n)], 1)[:, [0, 2, 1]]
    bottom = np.stack([last + k, last + (k + 1) % 6, np.full(6, n + 1)], 1)
    return np.vstack([p, ends]), np.vstack([faces[:, ::-1], top[:, ::-1], bottom[:, ::-1]])


def tree(depth: int) -> Mesh:
    """Thin planar branches of cubes."""
    size = 3 * 2**depth + 1
    solid = np.zeros((size, 2 * depth * 3 + 4, 1), dtype=bool)

    def grow(x: int, y: int, level: int) -> None:
        solid[x, y : y + 4] = True
        if level == 0:
            return
        reach = 3 * 2 ** (level - 1) // 2
        solid[x - reach : x + reach + 1, y + 3] = True
        for side in (-reach, reach):
            grow(x + side, y + 3, level - 1)

    grow(size // 2, 0, depth)
    return voxels(solid)


def slit() -> Mesh:
    """A plate with a cut of zero width, with duplicate vertices along it."""
    points, faces = bumpy(21)
    row = [10 * 21 + j for j in range(5, 16)]
    copies = {v: len(points) + k for k, v in enumerate(row[1:-1])}
    points = np.vstack([points, points[row[1:-1]]])
    low = (points[faces][:, :, 0].mean(1)) < points[row[0], 0]
    for old, new in copies.items():
        part = faces[low]
        part[part == old] = new
        faces[low] = part
    return points, faces


def crumpled() -> Mesh:
    """A torus with random vertex positions: it intersects itself everywhere."""
    points, faces = torus(10)
    return np.random.default_rng(5).normal(size=points.shape), faces


def on_a_line() -> Mesh:
    points, faces = grid(5, 5)
    return points * [1, 0, 0], faces


def at_a_point() -> Mesh:
    points, faces = grid(5, 5)
    return points * 0 + 3.0, faces


def million() -> Mesh:
    """A height field of a million triangles."""
    return bumpy(708)


def million_closed() -> Mesh:
    """A closed surface of a million triangles."""
    points, faces = ball(501)
    return points * (1 + 0.1 * np.sin(4 * points[:, :1])), faces


def with_value(value: float) -> Mesh:
    points, faces = ball(8)
    points[11, 1] = value
    return points, faces


SHAPES: dict[str, Shape] = {
    "triangles 1e3 : 1": Shape("slivers", partial(stretched, 1e3)),
    "triangles 1e6 : 1": Shape("slivers", partial(stretched, 1e6)),
    "triangles 1e9 : 1": Shape("slivers", partial(stretched, 1e9)),
    "needles 1e-3": Shape("slivers", partial(needles, 1e-3)),
    "needles 1e-6": Shape("slivers", partial(needles, 1e-6)),
    "needles 1e-9": Shape("slivers", partial(needles, 1e-9)),
    "needles 1e-13": Shape("slivers", partial(needles, 1e-13)),
    "slivers at random": Shape("slivers", caps),
    "faces of no area": Shape("slivers", zero_area),
    "edges 1e-9 long": Shape("slivers", partial(short_edges, 1e-9)),
    "edges 1e-15 long": Shape("slivers", partial(short_edges, 1e-15)),
    "spike 10": Shape("slivers", partial(spike, 10.0)),
    "spike 1e3": Shape("slivers", partial(spike, 1e3)),
    "spike 1e7": Shape("slivers", partial(spike, 1e7)),
    **{
        f"scale 1e{k}": Shape("scale", partial(moved, torus, 10.0**k))
        for k in (-25, -8, -4, 4, 8, 25)
    },
    **{
        f"scale 1e{k}": Shape("scale", partial(moved, torus, 10.0**k), REFUSED, "too small")
        for k in (-300, -40)
    },
    **{
        f"scale 1e{k}": Shape("scale", partial(moved, torus, 10.0**k), REFUSED, "too large")
        for k in (40, 300)
    },
    "1e3 from the origin": Shape("place", partial(moved, ball, 1.0, 1e3)),
    "1e6 from the origin": Shape("place", partial(moved, bumpy, 1.0, 1e6)),
    "1e8 from the origin": Shape("place", partial(moved, ball, 1.0, 1e8)),
    "1e12 from the origin": Shape("place", partial(moved, bumpy, 1.0, 1e12)),
    "1e17 from the origin": Shape("place", partial(moved, ball, 1.0, 1e17), REFUSED, "degenerate"),
    "faces twice": Shape("faces", doubled),
    "faces both ways": Shape("faces", both_ways),
    "all turned round": Shape("faces", partial(turned, 1.0)),
    "half turned round": Shape("faces", partial(turned, 0.5)),
    "isolated edges and points": Shape("faces", isolated),
    "Möbius strip": Shape("topology", moebius, REFUSED, "non-orientable"),
    "Klein bottle": Shape("topology", klein, REFUSED, "non-orientable"),
    "projective plane": Shape("topology", projective_plane, REFUSED, "non-orientable"),
    "book of three pages": Shape("topology", partial(book, 3), REFUSED, "non-manifold"),
    "book of two hundred pages": Shape("topology", partial(book, 200), REFUSED, "non-manifold"),
    "two balls that touch": Shape("topology", touching_balls, REFUSED, "connected components"),
    "pinched torus": Shape("topology", pinched_torus),
    "chessboard": Shape("topology", chessboard, REFUSED, "connected components"),
    **{
        f"{k} boundary loops": Shape("boundary loops", partial(holes, k))
        for k in (2, 3, 10, 20, 50)
    },
    **{
        f"ball with {k} pinholes": Shape("boundary loops", partial(ball_with_pinholes, k))
        for k in (1, 2, 20)
    },
    **{f"genus {k}": Shape("handles", partial(handles, k)) for k in range(1, 6)},
    "genus 2 with 3 loops": Shape("handles", handles_and_holes),
    "two parts": Shape("parts", partial(parts, 2, 1.0), REFUSED, "connected components"),
    "fifty parts": Shape("parts", partial(parts, 50, 1.0), REFUSED, "connected components"),
    "crumbs": Shape("parts", partial(parts, 40, 0.02)),
    "one triangle": Shape("few faces", one_triangle),
    "two triangles": Shape("few faces", two_triangles),
    "open fan of 3": Shape("few faces", partial(fan, 3)),
    "open fan of 200": Shape("few faces", partial(fan, 200)),
    "closed fan of 3": Shape("few faces", partial(fan, 3, True)),
    "closed fan of 200": Shape("few faces", partial(fan, 200, True)),
    "strip of 2000": Shape("few faces", partial(strip, 1000)),
    "tetrahedron": Shape("few faces", tetrahedron),
    "cube": Shape("few faces", cube),
    "pillow of two triangles": Shape("few faces", pillow),
    "long tube": Shape("odd forms", partial(tube, 100)),
    "tree": Shape("odd forms", partial(tree, 4)),
    "slit": Shape("odd forms", slit),
    "crumpled torus": Shape("odd forms", crumpled),
    "on a line": Shape("collapsed", on_a_line, REFUSED, "degenerate"),
    "at a point": Shape("collapsed", at_a_point, REFUSED, "degenerate"),
    "NaN": Shape("values", partial(with_value, np.nan), REFUSED, "NaN"),
    "infinity": Shape("values", partial(with_value, np.inf), REFUSED, "infinite"),
    "one vertex at 1e300": Shape("values", partial(with_value, 1e300), REFUSED, "too large"),
    "one vertex at 1e29": Shape("values", partial(with_value, 1e29), REFUSED, "degenerate"),
    "a million faces": Shape("size", million),
    "a million faces, closed": Shape("size", million_closed),
}
