"""Turn a mesh into a clean oriented manifold, or refuse it.

Only repairs that keep the shape are made, and each is logged. A mesh that needs a decision is
refused: of several connected components, and on non-manifold edges, the user decides by
:class:`Repairs`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from nsm.surfaces import holes, topology
from nsm.surfaces.caps import capped
from nsm.surfaces.cutting import first_copies
from nsm.surfaces.degenerate import distinct_corners, first_uses, without_degenerate
from nsm.surfaces.holes import fill
from nsm.surfaces.loading import as_arrays, check_arrays, error_in
from nsm.surfaces.recent import Recent, content
from nsm.wording import number_of

# Connected components below these shares of the area (each, and all together) are debris or
# trimmings, such as eyeballs behind a face, and are removed. If others are larger, the user must
# choose a component.
DROPPED_SHARE = 0.05
DROPPED_TOTAL = 0.10
# Neighbours closer than this share of the diagonal are duplicates of one vertex.
COINCIDENT = 1e-13
# Bounds on coordinates and on the size of the bounding box, in the file's unit: single precision,
# in which results are also written, cannot represent more.
LARGEST, SMALLEST = 1e30, 1e-30


@dataclass(frozen=True)
class Repairs:
    """Decisions on a mesh that is not one manifold.

    Attributes:
        parts: which connected component is kept: the largest, or that of a number, counted from 0
            by falling area; None: small ones are removed, and others refused.
        repair: split: the mesh is cut apart at non-manifold edges; None: they are refused.
        fill_holes: the largest number of edges of holes to fill; true: small ones; false: none.
        closed_area: close all other boundaries by caps, so that the mesh has this area (see
            :func:`nsm.surfaces.caps.capped`); None: they stay.
    """

    parts: Literal["largest"] | int | None = None
    repair: Literal["split"] | None = None
    fill_holes: bool | int = False
    closed_area: float | None = None


NO_DECISION = Repairs()
_CLEANED = Recent()


@dataclass(frozen=True)
class CleanMesh:
    """An oriented, connected manifold mesh.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3).
        source_vertex: (V,) the index of each vertex in the given mesh; -2, -3, ... for those in
            filled holes, and then those of caps.
        merged: (W,) for each given vertex its index here, or -1 if it was removed.
        log: one line per repair.
        cap_faces: how many faces, the last ones, are those of caps.
    """

    vertices: np.ndarray
    faces: np.ndarray
    source_vertex: np.ndarray
    merged: np.ndarray
    log: tuple[str, ...]
    cap_faces: int = 0

    @property
    def caps(self) -> np.ndarray | None:
        """Mask (F,) of the faces of caps; None: there are none."""
        count = len(self.faces)
        return np.arange(count) >= count - self.cap_faces if self.cap_faces else None


def clean(
    vertices: np.ndarray, faces: np.ndarray, name: str = "mesh", repairs: Repairs = NO_DECISION
) -> CleanMesh:
    """Make all repairs that keep the shape; the latest meshes are remembered by their content.

    Args:
        vertices: (W, 3).
        faces: (G, 3).
        name: the key of errors.
        repairs: what the user decides.

    Raises:
        NsmError: ``non_manifold``, ``disconnected``, ``not_orientable``, ``degenerate``,
            ``out_of_range`` (coordinates that single precision cannot represent), or as
            :func:`nsm.surfaces.loading.check_arrays`.
    """
    vertices, faces = as_arrays(vertices, faces, name)
    check_arrays(vertices, faces, name)
    key = (name, repairs, content(vertices, faces))
    return _CLEANED.get(key, lambda: _cleaned(vertices, faces, name, repairs))


def _cleaned(vertices: np.ndarray, faces: np.ndarray, name: str, repairs: Repairs) -> CleanMesh:
    _check_size(vertices, faces, name)
    log: list[str] = []
    representative = _weld_duplicates(vertices, faces, log)
    representative = _weld_short_edges(vertices, representative, faces, log)
    unreferenced = len(np.setdiff1d(representative, representative[faces]))
    if unreferenced:
        log.append(f"{number_of(unreferenced, 'unreferenced vertex')} removed")
    faces = without_degenerate(vertices, representative[faces], name, log)
    of_vertex = np.arange(len(vertices))
    if topology.edges_of(faces).count.max() > 2:
        faces, of_vertex = _split_edges(faces, name, repairs, log)
    faces = _keep_component(vertices[of_vertex], faces, name, repairs, log)
    faces = _orient(faces, name, log)

    split_faces, old = topology.cut_along(
        faces, np.zeros(len(topology.edges_of(faces).pairs), dtype=bool)
    )
    used = len(np.unique(faces))
    old = of_vertex[old]
    if len(old) > used:
        log.append(f"{number_of(len(old) - used, 'non-manifold vertex')} split")
        # components that were connected only by such a vertex are separate now
        split_faces = _keep_component(vertices[old], split_faces, name, repairs, log)
        kept = np.unique(split_faces)
        split_faces = np.searchsorted(kept, split_faces)
        old = old[kept]
    merged = first_copies(old, len(vertices))[representative]
    points, split_faces, filled = fill(vertices[old], split_faces, repairs.fill_holes)
    part = len(split_faces)
    if repairs.closed_area is not None:
        points, split_faces, closed = capped(points, split_faces, repairs.closed_area)
        filled += closed
    inserted = holes.FIRST - np.arange(len(points) - len(old))
    source = np.concatenate([old, inserted])
    caps = len(split_faces) - part
    return CleanMesh(points, split_faces, source, merged, (*log, *filled), caps)


def _check_size(vertices: np.ndarray, faces: np.ndarray, name: str) -> None:
    used = vertices[np.unique(faces)]
    largest = float(np.abs(used).max())
    if largest > LARGEST or 0 < np.ptp(used, axis=0).max() < SMALLEST:
        size = "large" if largest > LARGEST else "small"
        reason = f"too {size} for single precision (coordinates up to {largest:.3g}); scale it"
        raise error_in(name, "out_of_range", reason)


def _weld_duplicates(vertices: np.ndarray, faces: np.ndarray, log: list[str]) -> np.ndarray:
    """For each vertex (V,) the first vertex at exactly its place, or itself if none is welded.

    Nothing is welded if that would make a manifold mesh non-manifold, unless its triangles share no
    vertices at all (STL).
    """
    keep = np.arange(len(vertices))
    _, first, inverse = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    representative = first[inverse.ravel()]
    duplicates = len(vertices) - len(first)
    if duplicates == 0:
        return keep
    soup = len(faces) > 1 and len(np.unique(faces)) == faces.size
    if not soup and _makes_non_manifold(faces, representative[faces]):
        kept = number_of(duplicates, "duplicate vertex")
        log.append(f"{kept} kept: welding would make edges non-manifold")
        return keep
    log.append(f"{number_of(duplicates, 'duplicate vertex')} welded")
    return representative


def _weld_short_edges(
    vertices: np.ndarray, representative: np.ndarray, faces: np.ndarray, log: list[str]
) -> np.ndarray:
    """The representatives (V,), with the ends of edges shorter than COINCIDENT welded.

    Unchanged if that would make a manifold mesh non-manifold.
    """
    joined = representative[faces]
    pairs = topology.edges_of(joined).pairs
    used = vertices[np.unique(joined)]
    limit = COINCIDENT * float(np.linalg.norm(np.ptp(used, axis=0)))
    length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    short = pairs[(length <= limit) & (pairs[:, 0] != pairs[:, 1])]
    if len(short) == 0:
        return representative
    n = len(vertices)
    graph = coo_matrix((np.ones(len(short)), tuple(short.T)), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    welded = np.unique(label, return_index=True)[1][label][representative]
    if _makes_non_manifold(joined, welded[faces]):
        return representative
    count = len(np.unique(joined)) - len(np.unique(welded[faces]))
    log.append(f"{number_of(count, 'vertex')} welded across edges of zero length")
    return welded


def _makes_non_manifold(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether edges have more than two faces after welding (F, 3), but not before.

    Duplicate faces and faces that repeat a vertex do not count.
    """

    def most(faces: np.ndarray) -> int:
        faces = faces[distinct_corners(faces)]
        faces = faces[first_uses(faces)]
        return int(topology.edges_of(faces).count.max()) if len(faces) else 0

    return most(after) > 2 >= most(before)


def _split_edges(
    faces: np.ndarray, name: str, repairs: Repairs, log: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Faces (F, 3) cut apart at edges of three faces or more, and the vertex (V,) that each new
    one is a copy of."""
    edges = topology.edges_of(faces)
    count = int((edges.count > 2).sum())
    if repairs.repair is None:
        a, b = edges.pairs[int(edges.count.argmax())]
        where = f"{number_of(count, 'non-manifold edge')} (three or more faces), such as {a}-{b}"
        reason = f"{where}; surface.repair=split cuts the mesh apart there, or remove inner faces"
        raise error_in(name, "non_manifold", reason)
    log.append(f"cut apart at {number_of(count, 'non-manifold edge')}")
    # a fan of faces around a copy ends at cut edges, so that at most two faces share each of them
    return topology.cut_along(faces, edges.count > 2)


def _keep_component(
    vertices: np.ndarray, faces: np.ndarray, name: str, repairs: Repairs, log: list[str]
) -> np.ndarray:
    """The faces of the component that is chosen, or of the largest beside small ones."""
    label = topology.face_components(faces)
    count = int(label.max()) + 1
    if count == 1 and repairs.parts in (None, "largest", 0):
        return faces
    share = np.bincount(label, weights=topology.face_areas(vertices, faces))
    share = share / share.sum()
    order = np.argsort(-share, kind="stable")
    if repairs.parts is not None:
        number = 0 if repairs.parts == "largest" else int(repairs.parts)
        if not 0 <= number < count:
            last = {1: "0", 2: "0, 1"}.get(count, f"0 to {count - 1}")
            has = f"the mesh has {number_of(count, 'part')}"
            reason = f"surface.parts={number}: {has}; give {last} or largest"
            raise error_in(name, "out_of_range", reason)
        part = int(order[number])
        log.append(f"1 of {count} connected components kept, {100 * share[part]:.2f} % of the area")
        return faces[label == part]
    largest = int(order[0])
    others = np.delete(share, largest)
    if others.max() >= DROPPED_SHARE or others.sum() >= DROPPED_TOTAL:
        listed = ", ".join(f"{100 * s:.1f} %" for s in np.sort(share)[::-1][:6])
        where = f"{count} connected components ({listed} of the area)"
        reason = f"{where}; keep one with surface.parts=largest, or surface.parts=1 and so on"
        raise error_in(name, "disconnected", reason)
    dropped = 100 * others.sum()
    log.append(
        f"{number_of(count - 1, 'small connected component')} removed ({dropped:.2f} % of the area)"
    )
    return faces[label == largest]


def _orient(faces: np.ndarray, name: str, log: list[str]) -> np.ndarray:
    """Flip faces so that neighbours have the same orientation; most faces keep theirs."""
    pairs = topology.adjacent_faces(topology.edges_of(faces))
    i, j = (pairs // 3).T  # the two faces at each inner edge
    disagree = faces.ravel()[pairs[:, 0]] == faces.ravel()[pairs[:, 1]]
    if not disagree.any():
        return faces
    # In the orientation double cover each face is two nodes, itself and its mirror image. A
    # component is non-orientable exactly if some face is connected to its own mirror image.
    n = len(faces)
    a = np.concatenate([i, i + n])
    b = np.concatenate([np.where(disagree, j + n, j), np.where(disagree, j, j + n)])
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(2 * n, 2 * n)).tocsr()
    label = connected_components(graph, directed=False)[1]
    if (label[:n] == label[n:]).any():
        reason = "non-orientable (one-sided) surface; cut it open in a mesh editor"
        raise error_in(name, "not_orientable", reason)
    flipped = np.zeros(n, dtype=bool)
    done = np.zeros(n, dtype=bool)
    while not done.all():
        reached = breadth_first_order(
            graph, int(np.argmin(done)), directed=False, return_predecessors=False
        )
        kept, mirrored = reached[reached < n], reached[reached >= n] - n
        flipped[mirrored if len(mirrored) <= len(kept) else kept] = True
        done[reached % n] = True
    faces = faces.copy()
    faces[flipped] = faces[flipped][:, [0, 2, 1]]
    log.append(f"{number_of(int(flipped.sum()), 'face')} flipped to a consistent orientation")
    return faces
