"""The last vertices of a coarse closed mesh drawn together, whatever that does to its shape.

:mod:`nsm.domains.decimation` keeps shapes, so it stops at some hundred triangles on a thin or
bent mesh. What remains here is a handful: no limb is left that an embedding could squeeze.
"""

from __future__ import annotations

import math
from heapq import heappop, heappush

import numpy as np

from nsm.domains.decimation import Round


def collapsed(
    vertices: np.ndarray, faces: np.ndarray, held: np.ndarray, count: int
) -> tuple[np.ndarray, list[Round]]:
    """Collapse the shortest edges of a closed mesh (V, 3), (F, 3) until ``count`` faces are left.

    Args:
        held: (V,) mask of vertices that stay.

    Returns:
        the faces, those that are gone with two equal corners, and the rounds.
    """
    faces = faces.copy()
    around: list[set[int]] = [set() for _ in range(len(vertices))]  # faces of each vertex
    beside: list[set[int]] = [set() for _ in range(len(vertices))]  # its neighbours
    for f, corner in enumerate(faces.tolist()):
        for v in corner:
            around[v].add(f)
            beside[v].update(corner)
    for v, ring in enumerate(beside):
        ring.discard(v)
    points = vertices.tolist()
    left = len(faces)
    candidates = {int(v) for v in np.unique(faces)} - set(np.flatnonzero(held).tolist())
    best: dict[int, tuple[float, int]] = {}
    queue: list[tuple[float, int, int]] = []  # with some that are no more the best

    def look(v: int) -> None:
        ring, at = beside[v], points[v]
        best.pop(v, None)
        found: tuple[float, int] | None = None
        for w in ring:
            # the link condition, and no vertex with hardly any room around it
            common, size = ring & beside[w], len(ring) + len(beside[w])
            if len(common) != 2 or size < 7:
                continue
            one, other = common
            if len(around[one]) > 3 and len(around[other]) > 3:
                # vertices of high degree are hard to place again
                crowd = max(size - 4, 6) / 6
                option = math.dist(at, points[w]) * crowd, w
                if found is None or option < found:
                    found = option
        if found is not None:
            best[v] = found
            heappush(queue, (found[0], v, found[1]))

    for v in candidates:
        look(v)
    steps: list[list[tuple[int, int, list[int]]]] = []
    last = np.zeros(len(vertices), dtype=np.int64)  # how many rounds touched a vertex or its ring
    while left > count and best:
        cost, v, w = heappop(queue)
        if best.get(v) != (cost, w):
            continue
        del best[v]
        corners = [3 * f + faces[f].tolist().index(v) for f in sorted(around[v])]
        # into the first round after all that touched its ring
        touched = [v, *beside[v]]
        number = int(last[touched].max())
        last[touched] = number + 1
        if number == len(steps):
            steps.append([])
        steps[number].append((v, w, corners))
        gone = around[v] & around[w]
        near = beside[v] | beside[w]
        faces.ravel()[corners] = w
        for f in gone:
            for u in set(faces[f].tolist()):
                around[u].discard(f)
        around[w] |= around[v] - gone
        for u in beside[v]:
            beside[u].discard(v)
            if u != w:
                beside[u].add(w)
                beside[w].add(u)
        around[v], beside[v] = set(), set()
        candidates.discard(v)
        left -= len(gone)
        for u in near & candidates:
            look(u)
    return faces, [_round(step) for step in steps]


def _round(step: list[tuple[int, int, list[int]]]) -> Round:
    vertex, target, corners = zip(*step, strict=True)
    count = [len(c) for c in corners]
    return Round(
        np.array(vertex),
        np.array(target),
        np.full(len(vertex), -1),
        np.concatenate([np.array(c) for c in corners]),
        np.repeat(np.arange(len(vertex)), count),
    )
