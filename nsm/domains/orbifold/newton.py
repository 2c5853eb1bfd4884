"""Symmetric Dirichlet energy on R²/Γ, lowered by projected Newton steps in the reduced variables.

The energy of a triangle is A (‖J‖² + ‖J⁻¹‖²), J its Jacobian from the surface to the plane and A
its area on the surface. Second derivatives are made positive by their eigenvalues in closed form
(Smith, De Goes and Kim 2019, "Analytic eigensystems for isotropic distortion energies"). A step
stops short of the first triangle to lose its area, so none flips.
"""

from __future__ import annotations

import numpy as np

from nsm.compiled import compiled
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

    Jacobians are arrays (F, 2, 2), each in the lift of the triangle's first corner.

    Args:
        mesh: its triangles.
        seen: (3F, 2, 3) of its lifts, see :func:`nsm.domains.orbifold.stars.seen`.
        held: (V,) mask of vertices that do not move: cones, or one vertex of a torus.
    """

    def __init__(self, mesh: Triangles, seen: np.ndarray, held: np.ndarray) -> None:
        self.mesh, self.held = mesh, held
        self._lifts = seen[::3].copy()

    def jacobians(self, uv: np.ndarray, lattice: np.ndarray) -> np.ndarray:
        """(F, 2, 2) for canonical coordinates (V, 2) in the plane and a lattice (2, 2)."""
        return _jacobians(uv, lattice, self.mesh.faces, self._lifts, self.mesh.hats)

    def energy(self, j: np.ndarray) -> float:
        """The energy by the Jacobians; infinite if a triangle has no area."""
        return _energy(j, self.mesh.area)[0]

    def spread(self, j: np.ndarray) -> tuple[float, float]:
        """Mean and largest energy of the triangles, per area; infinite if one has none."""
        total, largest = _energy(j, self.mesh.area)
        return total / float(self.mesh.area.sum()), largest

    def best_shape(self, j: np.ndarray) -> np.ndarray:
        """The matrix (2, 2), symmetric with determinant 1, that lowers the energy most if it is
        applied to the plane: tr(A²C) + tr(A⁻²D) is least at A² = √|M| M⁻¹, M = C + adj D."""
        xx, xy, yy = _best_shape(j, self.mesh.area)
        return np.array([[xx, xy], [xy, yy]])

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
        slope, panels = self.derivatives(j)
        held = np.repeat(self.held[pattern.ids, None], 2, axis=1)
        solution = pattern.solution(panels, slope, held)
        if solution is None:  # singular: no step
            return uv, j, start, 0.0
        along = -float((slope * solution).sum())
        if not np.isfinite(along) or along >= 0:
            return uv, j, start, 0.0
        direction = np.zeros_like(uv)
        direction[pattern.ids] = -solution
        change = self.jacobians(direction, np.zeros((2, 2)))
        size = min(1.0, _BEFORE_FLIP * _first_flip(j, change))
        for _ in range(_BACKTRACKS):
            trial = uv + size * direction
            there = self.jacobians(trial, lattice)
            value = self.energy(there)
            if value <= start + _DECREASE * size * along:
                return trial, there, value, size
            size *= 0.5
        return uv, j, start, 0.0

    def derivatives(self, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The energy's gradient (N, 2) by the canonical coordinates of the pattern's vertices, zero
        where they are held, and positive second derivatives, in the pattern's panels."""
        mesh, pattern = self.mesh, self.mesh.pattern
        slope, panels = np.zeros((len(pattern.ids), 2)), np.zeros(pattern.size)
        _add_derivatives(
            j,
            mesh.hats,
            mesh.area,
            self._lifts,
            pattern.corner,
            self.held[pattern.ids],
            pattern.place,
            pattern.width,
            slope,
            panels,
        )
        return slope, panels


@compiled
def _jacobians(
    uv: np.ndarray, lattice: np.ndarray, faces: np.ndarray, lifts: np.ndarray, hats: np.ndarray
) -> np.ndarray:
    j = np.empty((len(faces), 2, 2))
    for f in range(len(faces)):
        for i in range(2):
            here = uv[faces[f, 0], i]
            b = lifts[f, 0, 0] * uv[faces[f, 1], i] - here
            b += lattice[i, 0] * lifts[f, 0, 1] + lattice[i, 1] * lifts[f, 0, 2]
            c = lifts[f, 1, 0] * uv[faces[f, 2], i] - here
            c += lattice[i, 0] * lifts[f, 1, 1] + lattice[i, 1] * lifts[f, 1, 2]
            j[f, i, 0] = b * hats[f, 0]
            j[f, i, 1] = b * hats[f, 1] + c * hats[f, 2]
    return j


@compiled
def _energy(j: np.ndarray, area: np.ndarray) -> tuple[float, float]:
    """The sum over the triangles, and the largest per area; infinite if one has no area."""
    total = largest = 0.0
    for f in range(len(j)):
        a, b, c, d = j[f, 0, 0], j[f, 0, 1], j[f, 1, 0], j[f, 1, 1]
        det = a * d - b * c
        if not det > 0:
            return np.inf, np.inf
        value = (a * a + b * b + c * c + d * d) * (1 + 1 / (det * det))
        total += area[f] * value
        largest = max(largest, value)
    return total, largest


@compiled
def _best_shape(j: np.ndarray, area: np.ndarray) -> tuple[float, float, float]:
    # C = Σ A JJᵀ; adj of Σ A J⁻ᵀ J⁻¹ = Σ A JJᵀ / det², up to a turn by a right angle in both
    trace = whole = 0.0
    for f in range(len(j)):
        a, b, c, d = j[f, 0, 0], j[f, 0, 1], j[f, 1, 0], j[f, 1, 1]
        trace += area[f] * (a * a + b * b + c * c + d * d)
        whole += area[f]
    # a few triangles that are nearly flat, for want of relaxation, do not decide
    least = _FLAT * trace / whole
    xx = xy = yy = 0.0
    for f in range(len(j)):
        a, b, c, d = j[f, 0, 0], j[f, 0, 1], j[f, 1, 0], j[f, 1, 1]
        det = max(a * d - b * c, least)
        weight = area[f] * (1 + 1 / (det * det))
        xx += weight * (a * a + b * b)
        xy += weight * (a * c + b * d)
        yy += weight * (c * c + d * d)
    # the root of a matrix P with determinant 1 is (P + I) / √(tr P + 2)
    root = np.sqrt(xx * yy - xy * xy)
    scale = np.sqrt((xx + yy) / root + 2)
    return (yy / root + 1) / scale, -xy / root / scale, (xx / root + 1) / scale


@compiled
def _half(x: float, y: float) -> tuple[float, float]:
    """Cosine and sine of half the angle of (x, y), up to a sign of both."""
    length = np.hypot(x, y)
    if length == 0:
        return 1.0, 0.0
    x, y = x / length, y / length
    if x > 0:
        c = np.sqrt(0.5 * (1 + x))
        return c, 0.5 * y / c
    s = np.sqrt(0.5 * (1 - x))
    return 0.5 * y / s, s


@compiled
def _add_derivatives(
    j: np.ndarray,
    hats: np.ndarray,
    area: np.ndarray,
    lifts: np.ndarray,
    corner: np.ndarray,
    held: np.ndarray,
    place: np.ndarray,
    width: np.ndarray,
    slope: np.ndarray,
    panels: np.ndarray,
) -> None:
    """Add gradient and second derivatives by canonical coordinates; held is by the numbers of
    corners."""
    values, a, b, sign = np.empty(4), np.empty(3), np.empty(3), np.ones(3)
    for f in range(len(j)):
        xx, xy, yx, yy = j[f, 0, 0], j[f, 0, 1], j[f, 1, 0], j[f, 1, 1]
        det, square = xx * yy - xy * yx, xx * xx + xy * xy + yx * yx + yy * yy
        x, y, z = hats[f, 0], hats[f, 1], hats[f, 2]
        sign[1], sign[2] = lifts[f, 0, 0], lifts[f, 1, 0]
        power = 1 / (det * det)
        inner, outer = 2 * area[f] * (1 + power), 2 * area[f] * power / det * square
        for i in range(2):
            by_x = inner * xx - outer * yy if i == 0 else inner * yx + outer * xy
            by_y = inner * xy + outer * yx if i == 0 else inner * yy - outer * xx
            second, third = by_x * x + by_y * y, by_y * z
            slope[corner[f, 0], i] -= second + third
            slope[corner[f, 1], i] += sign[1] * second
            slope[corner[f, 2], i] += sign[2] * third
        # J = U Σ Vᵀ; eigenmatrices U E Vᵀ with E = e11, e22, (e21 - e12)/√2, (e21 + e12)/√2
        e, h = 0.5 * (xx + yy), 0.5 * (yx - xy)
        g, k = 0.5 * (xx - yy), 0.5 * (yx + xy)
        turned = np.sqrt(g * g + k * k)
        large = np.sqrt(e * e + h * h) + turned
        small = det / large
        if turned == 0:
            g, k = 1.0, 0.0
        c, s = _half(e * g - h * k, e * k + h * g)  # of U
        p, q = _half(e * g + h * k, h * g - e * k)  # of Vᵀ
        product, of_large, of_small = large * small, large * large, small * small
        cube, squares = product * product * product, of_large + of_small
        values[0] = 2 + 6 / (of_large * of_large)
        values[1] = 2 + 6 / (of_small * of_small)
        values[2] = 2 - 2 * (squares - product) / cube
        values[3] = 2 + 2 * (squares + product) / cube
        for i in range(4):
            if not values[i] <= _STIFFEST:
                values[i] = _STIFFEST
            values[i] = area[f] * max(values[i], 1e-9)
        one, two = values[0], values[1]
        mean, half = 0.5 * (values[2] + values[3]), 0.5 * (values[3] - values[2])
        # hat functions' gradients along the columns of V
        a[1], a[2] = sign[1] * (p * x - q * y), -sign[2] * q * z
        b[1], b[2] = sign[1] * (q * x + p * y), sign[2] * p * z
        a[0], b[0] = q * y - p * x + q * z, -(q * x + p * y) - p * z
        cc, ss, cs = c * c, s * s, c * s
        for m in range(3):
            for n in range(3):
                at = place[f, m, n]
                if at < 0 or held[corner[f, m]] or held[corner[f, n]]:
                    continue
                aa, bb, ba, ab = a[m] * a[n], b[m] * b[n], b[m] * a[n], a[m] * b[n]
                both, mixed = half * (ba + ab), cs * ((one - mean) * aa + (mean - two) * bb)
                panels[at] += (cc * one + ss * mean) * aa + (cc * mean + ss * two) * bb - cs * both
                panels[at + 1] += mixed + half * ab - ss * both
                at += width[f, n]
                panels[at] += mixed + half * ba - ss * both
                panels[at + 1] += (
                    (ss * one + cc * mean) * aa + (ss * mean + cc * two) * bb + cs * both
                )
    for v in range(len(held)):
        if held[v]:
            slope[v] = 0.0


@compiled
def _first_flip(j: np.ndarray, change: np.ndarray) -> float:
    """The least t > 0 at which a triangle with Jacobian J + t dJ loses its area."""
    first = np.inf
    for f in range(len(j)):
        xx, xy, yx, yy = j[f, 0, 0], j[f, 0, 1], j[f, 1, 0], j[f, 1, 1]
        dxx, dxy, dyx, dyy = change[f, 0, 0], change[f, 0, 1], change[f, 1, 0], change[f, 1, 1]
        a, c = dxx * dyy - dxy * dyx, xx * yy - xy * yx
        b = xx * dyy + yy * dxx - xy * dyx - yx * dxy
        root = b * b - 4 * a * c
        if root >= 0:
            # the smallest positive root, without cancellation
            t = 2 * c / (np.sqrt(root) - b)
            if 0 < t < first:
                first = t
    return first


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
    of_face, area = hats(vertices, faces, 1e-9)
    x, y, z = of_face.T
    b, c = (corner[:, 1:] - corner[:, :1]).transpose(1, 2, 0)
    j = np.stack([b * x, b * y + c * z])
    det = j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]
    scale = area.sum() / (area * np.abs(det)).sum()
    trace, det = scale * (j * j).sum(axis=(0, 1)), (scale * det) ** 2
    return trace + (trace + 2 * epsilon) / (det + epsilon * trace + epsilon**2)
