"""Symmetric Dirichlet energy on R²/Γ, lowered by projected Newton steps in the reduced variables.

The energy of a triangle is A (‖J‖² + ‖J⁻¹‖²), J its Jacobian from the surface to the plane and A
its area on the surface. Second derivatives are made positive by their eigenvalues in closed form
(Smith, De Goes and Kim 2019, "Analytic eigensystems for isotropic distortion energies"). A step
stops short of the first triangle to lose its area, so none flips.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix

from nsm.domains.orbifold import group
from nsm.domains.orbifold.tutte import factorised

_STIFFEST = 1e8  # eigenvalues of second derivatives are kept below this
_FLAT = 1e-3
_BEFORE_FLIP = 0.9
_BACKTRACKS = 12
_DECREASE = 1e-4


def hat_gradients(
    vertices: np.ndarray, faces: np.ndarray, flattest: float = 1e-3
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients (F, 3, 2) of the corners' hat functions, in a frame of each face, and areas (F,).

    Triangles flatter than ``flattest``, height over length, get that height: nobody sees how the
    map distorts needles, and keeping their shape would cost digits.
    """
    # by coordinates: on a few hundred faces, each call of numpy counts
    a, b, c = vertices.T[:, faces.T].transpose(1, 0, 2)
    u, v = b - a, c - a
    lu = np.sqrt((u * u).sum(axis=0))
    mean = max(float(lu.sum()) / max(len(lu), 1), 1e-300)
    lu = np.maximum(lu, 1e-9 * mean)
    along = (u * v).sum(axis=0) / lu
    cross = u[[1, 2, 0]] * v[[2, 0, 1]] - u[[2, 0, 1]] * v[[1, 2, 0]]
    double = np.sqrt((cross * cross).sum(axis=0))
    longest = np.maximum(lu, np.sqrt((v * v).sum(axis=0)))
    double = np.maximum(double, flattest * longest**2)
    up = double / lu
    # the triangle (0, 0), (lu, 0), (along, up)
    gradients = np.zeros((len(lu), 3, 2))
    gradients[:, 1, 0], gradients[:, 1, 1] = 1 / lu, -along / (lu * up)
    gradients[:, 2, 1] = 1 / up
    gradients[:, 0] = -gradients[:, 1] - gradients[:, 2]
    return gradients, 0.5 * double


class Quotient:
    """The energy of a mesh on R²/Γ, as a function of canonical coordinates and the lattice.

    Args:
        vertices: (V, 3), scaled so that the mesh has the domain's area.
        faces: (F, 3).
        lift: (F, 3, 3).
        held: (V,) mask of vertices that do not move: cones, or one vertex of a torus.
    """

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, lift: np.ndarray, held: np.ndarray
    ) -> None:
        self.prepare(vertices, faces, lift)
        moving = ~held
        moving[np.setdiff1d(np.arange(self.n), faces)] = False
        self.free = np.flatnonzero(moving)
        number = np.full(self.n, -1)
        number[self.free] = np.arange(len(self.free))
        local = number[faces]
        dof = np.stack([2 * local, 2 * local + 1], axis=2).reshape(len(faces), 6)
        dof[np.repeat(local, 2, axis=1) < 0] = -1
        size = 2 * len(self.free)
        row, column = np.broadcast_arrays(dof[:, :, None], dof[:, None, :])
        self.kept = np.flatnonzero(((row >= 0) & (column >= 0)).ravel())
        keys = column.ravel()[self.kept].astype(np.int64) * size + row.ravel()[self.kept]
        unique, self.place = np.unique(keys, return_inverse=True)
        self.indices = (unique % size).astype(np.int32)
        self.indptr = np.searchsorted(unique // size, np.arange(size + 1)).astype(np.int32)
        self.size = size
        self.diagonal = np.searchsorted(unique, np.arange(size) * (size + 1))

    def prepare(self, vertices: np.ndarray, faces: np.ndarray, lift: np.ndarray) -> None:
        """What first derivatives need."""
        self.faces, self.n = faces, len(vertices)
        self.sign = lift[:, :, 0].astype(np.float64)
        self.shift = lift[:, :, 1:].astype(np.float64)
        self.gradients, self.area = hat_gradients(vertices, faces)

    def jacobians(self, uv: np.ndarray, lattice: np.ndarray) -> np.ndarray:
        """(F, 2, 2) for canonical coordinates (V, 2) in the plane and a lattice (2, 2)."""
        corner = self.sign[:, :, None] * uv[self.faces] + self.shift @ lattice.T
        return np.einsum("fki,fkj->fij", corner, self.gradients)

    def energy(self, uv: np.ndarray, lattice: np.ndarray) -> float:
        """The energy; infinite if a triangle has no area."""
        j = self.jacobians(uv, lattice)
        det = _det(j)
        if not (det > 0).all():
            return np.inf
        with np.errstate(over="ignore"):
            return float((self.area * (j**2).sum(axis=(1, 2)) * (1 + det**-2)).sum())

    def spread(self, uv: np.ndarray, lattice: np.ndarray) -> tuple[float, float]:
        """Mean and largest energy of the triangles, per area; infinite if one has none."""
        j = self.jacobians(uv, lattice)
        det = _det(j)
        if not (det > 0).all():
            return np.inf, np.inf
        value = (j**2).sum(axis=(1, 2)) * (1 + det**-2)
        return float(self.area @ value / self.area.sum()), float(value.max())

    def best_shape(self, uv: np.ndarray, lattice: np.ndarray) -> np.ndarray:
        """The matrix (2, 2), symmetric with determinant 1, that lowers the energy most if it is
        applied to the plane: tr(A²C) + tr(A⁻²D) is least at A² = √|M| M⁻¹, M = C + adj D."""
        j = self.jacobians(uv, lattice)
        det = _det(j)
        # a few triangles that are nearly flat, for want of relaxation, do not decide
        c = np.einsum("f,fij,fkj->ik", self.area, j, j)
        det = np.maximum(det, _FLAT * c.trace() / self.area.sum())
        # adj of Σ A J⁻ᵀ J⁻¹ = Σ A JJᵀ / det², up to a turn by a right angle in both
        m = c + np.einsum("f,fij,fkj->ik", self.area / det**2, j, j)
        value, vector = np.linalg.eigh(m)
        ratio = (value[1] / value[0]) ** 0.25
        return vector @ np.diag([ratio, 1 / ratio]) @ vector.T

    def step(self, uv: np.ndarray, lattice: np.ndarray) -> tuple[np.ndarray, float, float]:
        """One Newton step: the new coordinates (V, 2), their energy, and the step's length."""
        j = self.jacobians(uv, lattice)
        gradient, hessian = self._derivatives(j)
        direction = np.zeros((self.n, 2))
        data = np.bincount(
            self.place, weights=hessian.ravel()[self.kept], minlength=self.indptr[-1]
        )
        data[self.diagonal] = data[self.diagonal] * (1 + 1e-10)
        matrix = csc_matrix((data, self.indices, self.indptr), shape=(self.size, self.size))
        slope = self._gathered(gradient)
        try:
            solution = factorised(matrix).solve(slope[self.free].ravel())
        except RuntimeError:  # singular: no step
            return uv, self.energy(uv, lattice), 0.0
        direction[self.free] = -solution.reshape(-1, 2)
        change = np.einsum(
            "fki,fkj->fij", self.sign[:, :, None] * direction[self.faces], self.gradients
        )
        along = float((slope * direction).sum())
        if not np.isfinite(along) or along >= 0:
            return uv, self.energy(uv, lattice), 0.0
        size = min(1.0, _BEFORE_FLIP * _first_flip(j, change))
        start = self.energy(uv, lattice)
        for _ in range(_BACKTRACKS):
            trial = uv + size * direction
            value = self.energy(trial, lattice)
            if value <= start + _DECREASE * size * along:
                return trial, value, size
            size *= 0.5
        return uv, start, 0.0

    def _gathered(self, gradient: np.ndarray) -> np.ndarray:
        flat = self.faces.ravel()
        parts = (gradient * self.sign[:, :, None]).reshape(-1, 2)
        return np.stack(
            [np.bincount(flat, weights=parts[:, k], minlength=self.n) for k in range(2)], axis=1
        )

    def _derivatives(self, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (F, 3, 2) and positive second derivatives (F, 6, 6) by the corners' places,
        the second with signs of the lifts."""
        det = _det(j)
        square = (j**2).sum(axis=(1, 2))
        cofactor = np.stack(
            [
                np.stack([j[:, 1, 1], -j[:, 1, 0]], axis=1),
                np.stack([-j[:, 0, 1], j[:, 0, 0]], axis=1),
            ],
            axis=1,
        )
        with np.errstate(all="ignore"):
            by_j = (
                2 * (1 + det**-2)[:, None, None] * j
                - (2 * square * det**-3)[:, None, None] * cofactor
            )
        gradient = self.area[:, None, None] * np.einsum("fij,fkj->fki", by_j, self.gradients)
        left, large, small, right = _singular(j, det)
        with np.errstate(all="ignore"):
            product = large * small
            values = np.stack(
                [
                    2 + 6 * large**-4,
                    2 + 6 * small**-4,
                    2 - 2 * (large**2 - product + small**2) / product**3,
                    2 + 2 * (large**2 + product + small**2) / product**3,
                ],
                axis=1,
            )
        values = np.nan_to_num(values, nan=_STIFFEST, posinf=_STIFFEST).clip(1e-9, _STIFFEST)
        # eigenmatrices: U E Vᵀ with E = e11, e22, (e21 - e12)/√2, (e21 + e12)/√2
        p, q = left[:, :, 0], left[:, :, 1]
        r, s = right[:, 0], right[:, 1]  # rows of Vᵀ
        turned = np.stack(
            [
                np.einsum("fi,fk->fki", p, np.einsum("fj,fkj->fk", r, self.gradients)),
                np.einsum("fi,fk->fki", q, np.einsum("fj,fkj->fk", s, self.gradients)),
                np.einsum("fi,fk->fki", q, np.einsum("fj,fkj->fk", r, self.gradients)),
                np.einsum("fi,fk->fki", p, np.einsum("fj,fkj->fk", s, self.gradients)),
            ],
            axis=1,
        )
        mixed = turned[:, 2:].copy()
        turned[:, 2] = (mixed[:, 0] - mixed[:, 1]) * np.sqrt(0.5)
        turned[:, 3] = (mixed[:, 0] + mixed[:, 1]) * np.sqrt(0.5)
        turned *= self.sign[:, None, :, None]
        turned *= np.sqrt(values * self.area[:, None])[:, :, None, None]
        parts = turned.reshape(len(j), 4, 6)
        return gradient, parts.transpose(0, 2, 1) @ parts


def _det(j: np.ndarray) -> np.ndarray:
    return j[:, 0, 0] * j[:, 1, 1] - j[:, 0, 1] * j[:, 1, 0]


def _singular(
    j: np.ndarray, det: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """U (F, 2, 2), σ₁ ≥ σ₂ > 0 and Vᵀ (F, 2, 2), rotations both, of matrices with det > 0."""
    e, f = 0.5 * (j[:, 0, 0] + j[:, 1, 1]), 0.5 * (j[:, 0, 0] - j[:, 1, 1])
    g, h = 0.5 * (j[:, 1, 0] + j[:, 0, 1]), 0.5 * (j[:, 1, 0] - j[:, 0, 1])
    large = np.hypot(e, h) + np.hypot(f, g)
    one, other = np.arctan2(g, f), np.arctan2(h, e)
    return _rotations(0.5 * (other + one)), large, det / large, _rotations(0.5 * (other - one))


def _rotations(angle: np.ndarray) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def _first_flip(j: np.ndarray, change: np.ndarray) -> float:
    """The least t > 0 at which a triangle with Jacobian J + t dJ loses its area."""
    a, c = _det(change), _det(j)
    b = (
        j[:, 0, 0] * change[:, 1, 1]
        + j[:, 1, 1] * change[:, 0, 0]
        - j[:, 0, 1] * change[:, 1, 0]
        - j[:, 1, 0] * change[:, 0, 1]
    )
    root = b**2 - 4 * a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        # the smallest positive root, without cancellation
        t = 2 * c / (-b + np.sqrt(root))
    t = t[(root >= 0) & (t > 0)]
    return float(t.min(initial=np.inf))


def distortions(
    vertices: np.ndarray,
    faces: np.ndarray,
    lift: np.ndarray,
    x: np.ndarray,
    lattice: np.ndarray,
    epsilon: float = 0.01,
) -> np.ndarray:
    """Symmetric Dirichlet energy tr M + tr (M + εI)⁻¹ (F,) of each triangle, M = JᵀJ.

    Args:
        vertices: (V, 3) in any unit; areas are compared after both are scaled to the same total.
        x: (V, 2) in coordinates of the lattice (2, 2).
    """
    corner = group.moved(lift, x[faces]) @ lattice.T
    gradients, area = hat_gradients(vertices, faces, 1e-9)
    j = np.einsum("fki,fkj->fij", corner, gradients)
    det = _det(j)
    j *= np.sqrt(area.sum() / (area * np.abs(det)).sum())
    trace, det = (j**2).sum(axis=(1, 2)), _det(j) ** 2
    return trace + (trace + 2 * epsilon) / (det + epsilon * trace + epsilon**2)
