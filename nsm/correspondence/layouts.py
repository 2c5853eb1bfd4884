"""Coarse shapes laid out on the orbifold, and the affine maps between two layouts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from nsm.correspondence.coarse_shape import CoarseShape
from nsm.domains.orbifold.cover import located
from nsm.domains.orbifold.embedding import Embedding, embed_orbifold
from nsm.domains.orbifold.lifts import cone_lifts
from nsm.domains.orbifold.multiresolution import Effort
from nsm.domains.orbifold.newton import distortions
from nsm.domains.orbifold.tutte import best_lattice, edge_weights, tutte
from nsm.errors import NsmError
from nsm.surfaces import topology

_EFFORT = Effort(coarse=400, level=3, last=6, stop=1e-3)
_CELLS = 96  # of the table over the torus R²/2Z², along each side
_LARGEST_ENTRY = 2
_CLASSES = 2  # of isotopy kept for each order of the cones


@dataclass(frozen=True)
class Layout:
    """A coarse shape on the orbifold with four of its tips at the cones.

    Attributes:
        shape: the shape.
        tips: (4,) numbers of the tips among the shape's, at (0, 0), (1, 0), (1, 1), (0, 1).
        embedding: of its mesh.
        at: (F, 2) the middle of each triangle, in coordinates of Ω.
        inverse: (F, 2, 2) of each triangle's first fundamental form in these coordinates.
        area: (F,) of each triangle; their sum is one.
    """

    shape: CoarseShape
    tips: np.ndarray
    embedding: Embedding
    at: np.ndarray
    inverse: np.ndarray
    area: np.ndarray


@dataclass(frozen=True)
class Table:
    """A layout looked up on a grid of points (2 i / N, 2 j / N) over the torus R²/2Z².

    Attributes:
        vertex: (N, N) a vertex of the shape near the grid's point.
        log_metric: (N, N, 3) the logarithm m I + ((a, b), (b, -a)) of the first fundamental form
            in coordinates of Ω, as (m, a, b).
    """

    vertex: np.ndarray
    log_metric: np.ndarray

    def near(self, points: np.ndarray) -> np.ndarray:
        """Vertices (...) near points (..., 2) of Ω, in any lift."""
        n = len(self.vertex)
        i, j = np.moveaxis(np.mod(np.rint(0.5 * n * points).astype(np.int64), n), -1, 0)
        return np.asarray(self.vertex[i, j])


def quick_scores(
    shape: CoarseShape, tips: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """All sets of four tips, and how much Tutte's embedding of each distorts.

    Tutte's embedding alone orders sets much as the optimised one does, in a fraction of the time.

    Args:
        shape: the shape.
        tips: numbers of the tips to choose from; all by default.

    Returns:
        sets (S, 4), and the mean logarithms (S,) of their distortion.
    """
    numbers = range(len(shape.tips)) if tips is None else tips.tolist()
    sets = np.array(list(combinations(numbers, 4)))
    vertices, faces = shape.vertices, shape.faces
    weights, area = (
        edge_weights(vertices, faces, "mean_value"),
        topology.face_areas(vertices, faces),
    )
    scores = []
    for four in sets:
        cones = shape.tips[four]
        lift, _ = cone_lifts(vertices, faces, cones.tolist())
        x, quadratic = tutte(faces, lift, weights, cones)
        lattice = best_lattice(quadratic, 4.0)
        value = np.log(distortions(vertices, faces, lift, x, lattice))
        scores.append(float(area @ np.nan_to_num(value, nan=100.0) / area.sum()))
    return sets, np.array(scores)


def layout(shape: CoarseShape, tips: np.ndarray) -> Layout | None:
    """The layout with four of the tips at the cones; None if digits do not suffice."""
    try:
        embedding = embed_orbifold(
            shape.vertices, shape.faces, shape.tips[tips].tolist(), effort=_EFFORT
        )
    except NsmError:
        return None
    corner = embedding.corners()
    metric = _metrics(corner, shape.vertices[shape.faces])
    area = topology.face_areas(shape.vertices, shape.faces)
    return Layout(
        shape, tips, embedding, corner.mean(axis=1), np.linalg.inv(metric), area / area.sum()
    )


def table(laid_out: Layout) -> Table:
    """The table of a layout."""
    shape, embedding = laid_out.shape, laid_out.embedding
    line = np.arange(_CELLS) * 2.0 / _CELLS - 1.0
    half = _CELLS // 2
    upper = np.append(line[half:], 1.0)  # the rest by symmetry
    x, y = np.meshgrid(line, upper, indexing="ij")
    places = located(embedding, np.stack([x.ravel(), y.ravel()], axis=1))
    metric = _metrics(embedding.corners(), shape.vertices[shape.faces])
    nearest = shape.faces[places.face, places.weights.argmax(axis=1)].reshape(x.shape)
    log = _logarithm(metric)[places.face].reshape(*x.shape, 3)
    vertex = np.zeros((_CELLS, _CELLS), dtype=np.int64)
    logs = np.zeros((_CELLS, _CELLS, 3))
    # grid point k lies at -1 + 2 k / N, so -x is the point with number -k
    opposite = np.mod(-np.arange(_CELLS), _CELLS)
    columns = np.mod(np.arange(half, _CELLS + 1), _CELLS)
    for whole, part in ((vertex, nearest), (logs, log)):
        whole[:, opposite[columns]] = part[opposite]
        whole[:, columns] = part
    # rows and columns start at 0, not at -1
    return Table(*(np.roll(a, (half, half), axis=(0, 1)) for a in (vertex, logs)))


def affine_maps(
    source: Layout, target: Layout, determinant: int = 1
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The maps x ↦ B x + c of the orbifold to itself that distort least.

    B is a matrix of integers, up to sign, and c a half lattice point. They take the cones to one
    another in all 24 orders; for each order a few isotopy classes.

    Args:
        source, target: the layouts.
        determinant: of B; -1 for maps that turn the orientation around.

    Returns:
        matrices B (2, 2) and shifts c (2,), in coordinates of Ω.
    """
    ours, theirs = source.embedding.lattice, target.embedding.lattice
    back = np.linalg.inv(ours)
    of_class: dict[bytes, list[tuple[float, np.ndarray]]] = {}
    for entries in product(range(-_LARGEST_ENTRY, _LARGEST_ENTRY + 1), repeat=4):
        matrix = np.array(entries).reshape(2, 2)
        first = next((e for e in entries if e), 0)
        det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
        if det != determinant or first < 0:
            continue
        cost = float(((theirs @ matrix @ back) ** 2).sum())
        of_class.setdefault(np.mod(matrix, 2).tobytes(), []).append((cost, matrix))
    result = []
    for classes in of_class.values():
        for _, matrix in sorted(classes, key=lambda entry: entry[0])[:_CLASSES]:
            result += [(matrix, np.array(shift)) for shift in product((0, 1), repeat=2)]
    return result


def _metrics(corner: np.ndarray, points: np.ndarray) -> np.ndarray:
    """First fundamental forms (F, 2, 2) of triangles (F, 3, 3) over the plane's (F, 3, 2)."""
    flat = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)
    edges = np.stack([points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]], axis=2)
    jacobian = edges @ np.linalg.inv(flat)
    metric = jacobian.transpose(0, 2, 1) @ jacobian
    # no triangle so flat that digits are lost
    trace = np.trace(metric, axis1=1, axis2=2)
    metric += 1e-6 * trace[:, None, None] * np.eye(2)
    return np.asarray(metric)


def _logarithm(metric: np.ndarray) -> np.ndarray:
    """(m, a, b) of the logarithms of symmetric positive matrices (F, 2, 2)."""
    value, vector = np.linalg.eigh(metric)
    log = np.einsum("fij,fj,fkj->fik", vector, np.log(value), vector)
    half = 0.5 * (log[:, 0, 0] - log[:, 1, 1])
    return np.stack([0.5 * (log[:, 0, 0] + log[:, 1, 1]), half, log[:, 0, 1]], axis=1)
