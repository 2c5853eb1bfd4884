"""Symmetric Dirichlet energy on R²/Γ, lowered by projected Newton steps in the reduced variables.

The energy of a triangle is A (‖J‖² + ‖J⁻¹‖²), J its Jacobian from the surface to the plane and A
its area on the surface. Second derivatives are made positive by their eigenvalues in closed form
(Smith, De Goes and Kim 2019, "Analytic eigensystems for isotropic distortion energies"). A step
stops short of the first triangle to lose its area, so none flips.
"""

from __future__ import annotations

import numpy as np

from nsm.domains.orbifold import group
from nsm.domains.orbifold.stars import hats
from nsm.domains.orbifold.triangles import Triangles

_STIFFEST = 1e8  # eigenvalues of second derivatives are kept below this
_FLAT = 1e-3
_BEFORE_FLIP = 0.9
_BACKTRACKS = 12
_DECREASE = 1e-4


class Quotient:
    """The energy of a mesh on R²/Γ, as a function of canonical coordinates and the lattice.

    Jacobians are arrays (2, 2, F), by rows and columns, each in the lift of the triangle's first
    corner.

    Args:
        mesh: its triangles.
        seen: (2, 3, 3F) of its lifts, see :func:`nsm.domains.orbifold.stars.seen`.
        held: (V,) mask of vertices that do not move: cones, or one vertex of a torus.
    """

    def __init__(self, mesh: Triangles, seen: np.ndarray, held: np.ndarray) -> None:
        self.mesh, self.held = mesh, held
        lifts = seen[:, :, ::3]
        self._corners = np.ascontiguousarray(mesh.faces.T)
        self._sign = lifts[:, 0]
        self._shift = lifts[:, 1:].transpose(1, 0, 2).reshape(2, -1)

    def jacobians(self, uv: np.ndarray, lattice: np.ndarray) -> np.ndarray:
        """(2, 2, F) for canonical coordinates (V, 2) in the plane and a lattice (2, 2)."""
        return self._along(uv, (lattice @ self._shift).reshape(2, 2, -1))

    def _along(self, uv: np.ndarray, shift: np.ndarray | float) -> np.ndarray:
        """Jacobians, with places of second and third corners shifted."""
        at = uv.T.take(self._corners, axis=1)
        sides = self._sign * at[:, 1:] - at[:, :1] + shift
        x, y, z = self.mesh.hats
        return np.stack([sides[:, 0] * x, sides[:, 0] * y + sides[:, 1] * z], axis=1)

    def energy(self, j: np.ndarray) -> float:
        """The energy by the Jacobians; infinite if a triangle has no area."""
        return float(self.mesh.area @ _densities(j))

    def spread(self, j: np.ndarray) -> tuple[float, float]:
        """Mean and largest energy of the triangles, per area; infinite if one has none."""
        value = _densities(j)
        return float(self.mesh.area @ value / self.mesh.area.sum()), float(value.max())

    def best_shape(self, j: np.ndarray) -> np.ndarray:
        """The matrix (2, 2), symmetric with determinant 1, that lowers the energy most if it is
        applied to the plane: tr(A²C) + tr(A⁻²D) is least at A² = √|M| M⁻¹, M = C + adj D."""
        # C = Σ A JJᵀ; adj of Σ A J⁻ᵀ J⁻¹ = Σ A JJᵀ / det², up to a turn by a right angle in both
        products = (j[[0, 0, 1]] * j[[0, 1, 1]]).sum(axis=1)
        area = self.mesh.area
        c = products @ area
        # a few triangles that are nearly flat, for want of relaxation, do not decide
        det = np.maximum(_det(j), _FLAT * (c[0] + c[2]) / area.sum())
        xx, xy, yy = c + products @ (area / det**2)
        value, vector = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
        ratio = (value[1] / value[0]) ** 0.25
        return np.asarray(vector @ np.diag([ratio, 1 / ratio]) @ vector.T)

    def step(
        self, uv: np.ndarray, lattice: np.ndarray, j: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """One Newton step.

        Args:
            uv, lattice: (V, 2) and (2, 2).
            j: the Jacobians there.

        Returns:
            the new coordinates (V, 2) and Jacobians, their energy, and the step's length.
        """
        start, pattern = self.energy(j), self.mesh.pattern
        gradient, hessian = self._derivatives(j)
        slope = self._gathered(gradient)
        slope[self.held] = 0.0
        direction = np.zeros_like(uv)
        try:
            solution = pattern.factorised(hessian, self.held).solve(slope[pattern.ids].ravel())
        except RuntimeError:  # singular: no step
            return uv, j, start, 0.0
        direction[pattern.ids] = -solution.reshape(-1, 2)
        change = self._along(direction, 0.0)
        along = float((slope * direction).sum())
        if not np.isfinite(along) or along >= 0:
            return uv, j, start, 0.0
        size = min(1.0, _BEFORE_FLIP * _first_flip(j, change))
        for _ in range(_BACKTRACKS):
            trial = uv + size * direction
            there = self.jacobians(trial, lattice)
            value = self.energy(there)
            if value <= start + _DECREASE * size * along:
                return trial, there, value, size
            size *= 0.5
        return uv, j, start, 0.0

    def _gathered(self, gradient: np.ndarray) -> np.ndarray:
        """The gradient (V, 2) by canonical coordinates, of that (2, 3, F) by corners."""
        corners, count = self._corners.ravel(), len(self.mesh.vertices)
        return np.stack([np.bincount(corners, g.ravel(), count) for g in gradient], axis=1)

    def _derivatives(self, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (2, 3, F) and positive second derivatives (2, 2, 3, 3, F) by coordinates of
        corners, as canonical coordinates move these."""
        x, y, z = self.mesh.hats
        det, area = _det(j), self.mesh.area
        with np.errstate(all="ignore"):
            power = 1 / (det * det)
            inner, outer = 2 * area * (1 + power), 2 * area * power / det * (j * j).sum(axis=(0, 1))
            cofactor = np.array([[j[1, 1], -j[1, 0]], [-j[0, 1], j[0, 0]]])
            by_j = inner * j - outer * cofactor
        gradient = self._by_corners(by_j[:, 0] * x + by_j[:, 1] * y, by_j[:, 1] * z)
        # J = U Σ Vᵀ; eigenmatrices U E Vᵀ with E = e11, e22, (e21 - e12)/√2, (e21 + e12)/√2
        (c, s), large, small, (p, q) = _singular(j, det)
        with np.errstate(all="ignore"):
            product, of_large, of_small = large * small, large * large, small * small
            cube, squares = product * product * product, of_large + of_small
            values = np.array(
                [
                    2 + 6 / (of_large * of_large),
                    2 + 6 / (of_small * of_small),
                    2 - 2 * (squares - product) / cube,
                    2 + 2 * (squares + product) / cube,
                ]
            )
        values = np.nan_to_num(values, nan=_STIFFEST, posinf=_STIFFEST).clip(1e-9, _STIFFEST)
        one, two, skew, twist = values * area
        mean, half = 0.5 * (skew + twist), 0.5 * (twist - skew)
        # hat functions' gradients along the columns of V
        a, b = self._by_corners(p * x - q * y, -q * z), self._by_corners(q * x + p * y, p * z)
        aa, bb, ba = a[:, None] * a, b[:, None] * b, b[:, None] * a
        cc, ss, cs = c * c, s * s, c * s
        both = half * (ba + ba.transpose(1, 0, 2))
        hessian = np.empty((2, 2, *aa.shape))
        hessian[0, 0] = (cc * one + ss * mean) * aa + (cc * mean + ss * two) * bb - cs * both
        hessian[1, 1] = (ss * one + cc * mean) * aa + (ss * mean + cc * two) * bb + cs * both
        hessian[0, 1] = cs * ((one - mean) * aa + (mean - two) * bb) + half * ba - ss * both
        hessian[1, 0] = hessian[0, 1].transpose(1, 0, 2)
        return gradient, hessian

    def _by_corners(self, second: np.ndarray, third: np.ndarray) -> np.ndarray:
        """Values (..., 3, F) at corners that add up to zero, by those (..., F) at two of them, with
        the signs of lifts."""
        return np.stack([-second - third, self._sign[0] * second, self._sign[1] * third], axis=-2)


def _det(j: np.ndarray) -> np.ndarray:
    return np.asarray(j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0])


def _densities(j: np.ndarray) -> np.ndarray:
    """Energy per area (F,) of each triangle; all infinite if one has no area."""
    det = _det(j)
    if not (det > 0).all():
        return np.full(len(det), np.inf)
    with np.errstate(over="ignore", divide="ignore"):
        return np.asarray((j * j).sum(axis=(0, 1)) * (1 + 1 / (det * det)))


def _singular(
    j: np.ndarray, det: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """J = U Σ Vᵀ for matrices with det > 0: cosine and sine (2, F) of the rotation U, σ₁ ≥ σ₂ > 0
    (F,), and cosine and sine of Vᵀ."""
    e, f = 0.5 * (j[0, 0] + j[1, 1]), 0.5 * (j[0, 0] - j[1, 1])
    g, h = 0.5 * (j[1, 0] + j[0, 1]), 0.5 * (j[1, 0] - j[0, 1])
    large = np.sqrt(e * e + h * h) + np.sqrt(f * f + g * g)
    one, other = np.arctan2(g, f), np.arctan2(h, e)
    left, right = 0.5 * (other + one), 0.5 * (other - one)
    return _turn(left), large, det / large, _turn(right)


def _turn(angle: np.ndarray) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def _first_flip(j: np.ndarray, change: np.ndarray) -> float:
    """The least t > 0 at which a triangle with Jacobian J + t dJ loses its area."""
    a, c = _det(change), _det(j)
    b = (
        j[0, 0] * change[1, 1]
        + j[1, 1] * change[0, 0]
        - j[0, 1] * change[1, 0]
        - j[1, 0] * change[0, 1]
    )
    root = b * b - 4 * a * c
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
    (x, y, z), area = hats(vertices, faces, 1e-9)
    b, c = (corner[:, 1:] - corner[:, :1]).transpose(1, 2, 0)
    j = np.stack([b * x, b * y + c * z], axis=1)
    j *= np.sqrt(area.sum() / (area * np.abs(_det(j))).sum())
    trace, det = (j * j).sum(axis=(0, 1)), _det(j) ** 2
    return trace + (trace + 2 * epsilon) / (det + epsilon * trace + epsilon**2)
