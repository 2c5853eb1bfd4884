"""Isotopy classes of maps between closed surfaces laid out on Ω = R²/Γ, and the best of them.

A homeomorphism of Ω lifts to h(x) = g(B x + c), where g commutes with Γ, B is in SL(2, Z), and
x ↦ B x + c takes Γ to itself. On the orbifold c is an integer vector, B and c count modulo Γ (up to
one sign, and c modulo 2), and the classes are those of homeomorphisms that permute the cones: B and
c modulo 2 tell the cones' order, the rest of B the paths between them; a wrong one is a Dehn twist.
On the torus c is any vector, since translations do not change the class (Farb and Margalit, "A
Primer on Mapping Class Groups", sections 2.2.4 and 2.2.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from nsm.domains.orbifold.cover import lifted_near
from nsm.domains.orbifold.domain import ClosedDomain
from nsm.domains.orbifold.embedding import SIDE, reduced_basis
from nsm.domains.surface import Surface
from nsm.errors import NsmError
from nsm.surfaces import topology

Landmarks = tuple[np.ndarray, np.ndarray]

_ENTRIES = 9  # largest entry of a class in reduced bases of both lattices
_CLASSES = 192  # maps whose lattices differ least, that are looked at
_FEW, _MANY = 300, 2500  # triangles of the source, for all of them and for the best
_FINALISTS = 12
_SHIFTS = 8  # per axis, of a torus without landmarks
_HALVINGS = 4  # of the step between them, around the best
_EPSILON = 0.01  # METHOD Eq. 2
_WORST = 1e3  # upper bound on a triangle's distortion
# weight of the landmarks' distances, in the unit in which a disc of Ω's area has the radius 1,
# beside the logarithm of the distortion
_MISS = 3.0


@dataclass(frozen=True)
class Alignment:
    """The map x ↦ B x + c of Ω, with which a map of an isotopy class begins.

    Attributes:
        matrix: B (2, 2), integers with determinant 1.
        shift: c (2,), 0 or 1 on the orbifold; in [-1, 1) on the torus.
        distortion: mean logarithm of the symmetric Dirichlet energy of the map from the source
            to the target, weighted by area; each triangle counts 1,000 at most.
        miss: root mean square distance, in the plane of the target's lattice, of landmarks from
            the target's nearest ones.
        score: what alignments are compared by; the least is best.
    """

    matrix: np.ndarray
    shift: np.ndarray
    distortion: float
    miss: float

    @property
    def score(self) -> float:
        return self.distortion + _MISS * self.miss

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """B x + c at points (N, 2) of Ω."""
        return points @ self.matrix.T + self.shift

    def then(self, other: Alignment) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and shift of this map followed by another."""
        return other.matrix @ self.matrix, other(self.shift[None])[0]

    @property
    def inverse(self) -> Alignment:
        """The map back, x ↦ B⁻¹(x - c), with the same figures."""
        back = np.rint(np.linalg.inv(self.matrix)).astype(np.int64)
        return replace(self, matrix=back, shift=-back @ self.shift)

    def lifted(self, points: np.ndarray, targets: np.ndarray, target: Surface) -> np.ndarray:
        """Of the lifts of target points (L, 2) those (L, 2) nearest to the images of points (L, 2).

        Distances are those in the plane of the target's lattice.
        """
        return lifted_near(targets, self(points), _domain(target).even, target.lattice)


def alignments(
    source: Surface, target: Surface, landmarks: Landmarks | None = None
) -> list[Alignment]:
    """The likely isotopy classes of maps from one closed surface to another, best first.

    Of all maps x ↦ B x + c that keep Γ those are compared for which the two lattices differ least
    (by the singular values of L_t B L_s⁻¹), by distortion and by how far they miss the landmarks. A
    landmark that is a cone of both surfaces must go to itself. On the torus, c is where the
    landmarks are missed least, or, without landmarks, where the distortion is least.

    Args:
        source, target: on the same closed domain.
        landmarks: corresponding vertices (L,) of each mesh file, if any.

    Raises:
        NsmError: ``wrong_domain`` for surfaces of another domain; ``not_on_surface`` for a
            landmark that a surface does not have.
    """
    domain = _domain(source)
    if _domain(target) != domain:
        raise NsmError(
            f"{source.name} lies on the {source.domain}, {target.name} on the {target.domain}; "
            "a map needs one domain",
            kind="wrong_domain",
            key=target.name,
        )
    pair = Judge(source, target, landmarks)
    p, q = pair.p, pair.q
    found = _candidates(source, target)
    if domain.even:
        cone = np.logical_and(*((x == np.rint(x)).all(axis=1) for x in (p, q)))
        shift = np.array(list(product((0.0, 1.0), repeat=2)))
        off = p[cone] @ found.transpose(0, 2, 1) - q[cone]  # (M, L, 2)
        held = (np.mod(off[:, None] + shift[:, None], 2) == 0).all(axis=(2, 3))
        of_b, of_c = (number[:_CLASSES] for number in np.nonzero(held))
        classes = found[of_b], shift[of_c]
    elif len(p):
        some = found[: _CLASSES // 4]
        classes = some, np.stack([pair.mean_shift(b) for b in some])
    else:
        classes = pair.best_shifts(found[: _CLASSES // 16])
    first = sorted(pair.alignments(*classes, _FEW), key=lambda a: a.score)[:_FINALISTS]
    matrices = np.array([a.matrix for a in first]).reshape(-1, 2, 2)
    shifts = np.array([a.shift for a in first]).reshape(-1, 2)
    best = pair.alignments(matrices, shifts)
    return sorted(best, key=lambda a: a.score)


def _domain(surface: Surface) -> ClosedDomain:
    if not isinstance(surface.domain, ClosedDomain) or surface.lattice is None:
        raise NsmError(
            f"{surface.name} lies on the {surface.domain}, which has no isotopy classes; take "
            "domain=orbifold or domain=torus",
            kind="wrong_domain",
            key=surface.name,
        )
    return surface.domain


def _candidates(source: Surface, target: Surface) -> np.ndarray:
    """Matrices B (M, 2, 2) of SL(2, Z), one of each pair ±B on the orbifold, that change the
    lattices' shapes least, in the order of the larger singular value of L_t B L_s⁻¹."""
    assert source.lattice is not None and target.lattice is not None
    bases = [reduced_basis(s.lattice) for s in (source, target) if s.lattice is not None]
    one, other = source.lattice @ bases[0], target.lattice @ bases[1]
    entries = np.arange(-_ENTRIES, _ENTRIES + 1)
    column = np.stack(np.meshgrid(entries, entries, indexing="ij"), axis=-1).reshape(-1, 2)
    first, second = (i.ravel() for i in np.meshgrid(*[np.arange(len(column))] * 2, indexing="ij"))
    a, b = column[first], column[second]
    unit = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] == 1
    matrix = np.stack([a[unit], b[unit]], axis=2)
    if _domain(source).even:
        flat = matrix.reshape(-1, 4)
        leading = flat[np.arange(len(flat)), (flat != 0).argmax(axis=1)]
        matrix = matrix[leading > 0]
    change = other @ matrix @ np.linalg.inv(one)
    # determinant 1: the sum of squares orders as the larger singular value does
    order = np.argsort((change**2).sum(axis=(1, 2)).round(9), kind="stable")
    back = np.rint(np.linalg.inv(bases[0])).astype(np.int64)
    return np.asarray(bases[1] @ matrix[order] @ back)


class Judge:
    """Two surfaces, and what their maps x ↦ B x + c are judged by; arguments as for
    :func:`alignments`."""

    def __init__(
        self, source: Surface, target: Surface, landmarks: Landmarks | None = None
    ) -> None:
        self.source, self.target = source, target
        given = landmarks or (np.zeros(0, dtype=int),) * 2
        self.p, self.q = (
            s.preimages(i.tolist()).reshape(-1, 2)
            for s, i in zip((source, target), given, strict=True)
        )
        self.even = _domain(source).even
        corners = source.uv[source.faces]
        self.middle = corners.mean(axis=1)
        self.rest = _forms(source.vertices, source.uv, source.faces)
        self.area = topology.face_areas(source.vertices, source.faces)
        self.forms = _forms(target.vertices, target.uv, target.faces)
        assert target.lattice is not None
        self.shape = target.lattice / SIDE

    def alignment(self, matrix: np.ndarray, shift: np.ndarray, count: int = _MANY) -> Alignment:
        """Judged by about ``count`` of the source's triangles."""
        return self.alignments(matrix[None], shift[None], count)[0]

    def alignments(
        self, matrices: np.ndarray, shifts: np.ndarray, count: int = _MANY
    ) -> list[Alignment]:
        """Of matrices (M, 2, 2) and shifts (M, 2), each as :meth:`alignment`."""
        chosen = np.unique(np.linspace(0, len(self.area) - 1, count).astype(int))
        image = self.middle[chosen] @ matrices.transpose(0, 2, 1) + shifts[:, None]
        face = self.target.layout.locate(image.reshape(-1, 2)).face.reshape(image.shape[:2])
        value = _symmetric_dirichlet(self.rest[chosen], _pulled_back(self.forms[face], matrices))
        distortion = np.average(np.log(value), axis=1, weights=self.area[chosen])
        misses = self.misses(matrices, shifts)
        figures = zip(matrices, shifts, distortion.tolist(), misses, strict=True)
        return [Alignment(*one) for one in figures]

    def misses(self, matrices: np.ndarray, shifts: np.ndarray) -> list[float]:
        """Root mean square distances of the landmarks."""
        if len(self.p) == 0:
            return [0.0] * len(matrices)
        gap = self.gap(matrices, shifts) @ self.shape.T
        return [float(x) for x in np.sqrt((gap**2).sum(axis=2).mean(axis=1))]

    def gap(self, matrices: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """From the landmarks' images to the target's nearest lifts: (M, L, 2)."""
        image = self.p @ matrices.transpose(0, 2, 1) + shifts[:, None]
        wanted = np.tile(self.q, (len(image), 1))
        lifted = lifted_near(wanted, image.reshape(-1, 2), self.even, self.target.lattice)
        return lifted.reshape(image.shape) - image

    def mean_shift(self, matrix: np.ndarray) -> np.ndarray:
        """The translation of a torus that brings the landmarks together best."""
        angle = np.pi * (self.q - self.p @ matrix.T)
        shift = np.angle(np.exp(1j * angle).mean(axis=0)) / np.pi
        for _ in range(5):  # now the mean of the nearest lifts
            shift = shift + self.gap(matrix[None], shift[None])[0].mean(axis=0)
        return np.mod(shift + 1, SIDE) - 1

    def best_shifts(self, matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrices (M, 2, 2) with translations (M, 2) of a torus for which the distortion is least
        nearby."""
        step = SIDE / _SHIFTS
        grid = -1 + step * np.array(list(product(range(_SHIFTS), repeat=2)))
        found: list[Alignment] = []
        for matrix in matrices:
            every = self.alignments(np.broadcast_to(matrix, (len(grid), 2, 2)), grid, _FEW)
            score = np.array([a.score for a in every]).reshape(_SHIFTS, _SHIFTS)
            around = [np.roll(score, d, axis=(0, 1)) for d in product((-1, 0, 1), repeat=2)]
            found += [every[k] for k in np.flatnonzero(score <= np.min(around, axis=0))]
        around_it = step * np.array(list(product((-1, 0, 1), repeat=2)))
        result: list[tuple[np.ndarray, np.ndarray]] = []
        for best in sorted(found, key=lambda a: a.score)[:_FINALISTS]:
            for k in range(1, _HALVINGS + 1):
                shifts = best.shift + around_it / 2**k
                same = np.broadcast_to(best.matrix, (len(shifts), 2, 2))
                best = min([best, *self.alignments(same, shifts, _FEW)], key=lambda a: a.score)
            result.append((best.matrix, np.mod(best.shift + 1, SIDE) - 1))
        matrix, shift = zip(*result, strict=True)
        return np.stack(matrix), np.stack(shift)


def _forms(vertices: np.ndarray, uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """First fundamental forms of a mesh (V, 3) over its coordinates (V, 2), as rows (F, 3) of
    their entries 11, 12 and 22."""
    (a, b), (u, v) = ([x[faces[:, k]] - x[faces[:, 0]] for k in (1, 2)] for x in (vertices, uv))
    with np.errstate(all="ignore"):
        inverse = 1 / (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])[:, None]
        by_u = (a * v[:, 1:] - b * u[:, 1:]) * inverse
        by_v = (b * u[:, :1] - a * v[:, :1]) * inverse
        entries = [
            np.einsum("fk,fk->f", *two) for two in ((by_u, by_u), (by_u, by_v), (by_v, by_v))
        ]
    return np.stack(entries, axis=1)


def _pulled_back(forms: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """BᵀFB (M, N, 3) of forms F (M, N, 3), as :func:`_forms` has them, and B (M, 2, 2)."""
    (a, b), (c, d) = matrices.transpose(1, 2, 0).astype(np.float64)
    rows = [[a * a, a * b, b * b], [2 * a * c, a * d + b * c, 2 * b * d], [c * c, c * d, d * d]]
    return np.asarray(forms @ np.array(rows).transpose(2, 0, 1))


def _symmetric_dirichlet(rest: np.ndarray, image: np.ndarray) -> np.ndarray:
    """tr M + tr (M + εI)⁻¹, at most 1,000, of maps that pull forms (..., 3) back to others."""
    (e, f, g), (h, m, n) = (np.moveaxis(x, -1, 0) for x in (rest, image))
    with np.errstate(all="ignore"):
        inverse = 1 / (e * g - f * f)
        trace = (g * h - 2 * f * m + e * n) * inverse
        determinant = (h * n - m * m) * inverse
        value = trace + (trace + 2 * _EPSILON) / (determinant + _EPSILON * trace + _EPSILON**2)
    return np.where(np.isfinite(value) & (value > 0), value, _WORST).clip(1.0, _WORST)
