"""Closed surfaces in closed form: the sphere and ellipsoids over the orbifold 2222, and tori.

Each is a function of (u, v) in any lift that has the symmetries of R²/Γ (see
:mod:`nsm.maps.lattice_grid`), degree one, and normals that point outwards.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from nsm.maps.analytic import ANALYTIC, AnalyticSurface, Triple
from nsm.maps.bsplines import into_domain

_SIDE = 128  # nodes along each side of [-1, 1]²
_TERMS = 5  # of a theta series; the first one left out is below 1e-17 of the sum


class ClosedAnalyticSurface(AnalyticSurface):
    """A closed surface R²/Γ → R³ in closed form; subclasses answer ``closed_point``.

    Args:
        area, **parameters: as for :class:`AnalyticSurface`.
    """

    closed_domain: ClassVar[str]
    even: ClassVar[bool]  # whether x and -x are one point

    def _nodes(self) -> tuple[Tensor, Tensor, float]:
        # evenly spaced nodes: for periodic smooth functions the error falls exponentially
        t = (torch.arange(_SIDE, dtype=torch.float64) + 0.5) * (2 / _SIDE) - 1
        corners = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=t.dtype)] * 2)
        return torch.cartesian_prod(t, t), corners, 2.0 if self.even else 4.0

    def point(self, u: Tensor, v: Tensor) -> Triple:
        u, v = into_domain(torch.stack([u, v]), self.even)[0]
        return self.closed_point(u, v)

    def closed_point(self, u: Tensor, v: Tensor) -> Triple:
        """Unscaled coordinates, each (N,), at points u (N,), v (N,) of the fundamental domain."""
        raise NotImplementedError

    def lattice(self) -> Tensor:
        """The lattice L (2, 2) of determinant 1, upright, for which the surface is least stretched.

        The Dirichlet energy of the map from the plane of L x is ∫ tr(JᵀJ (LᵀL)⁻¹), least where LᵀL
        is a multiple of ∫ JᵀJ.
        """
        jacobian = self.value_and_jacobian(self._nodes()[0])[1]
        root = torch.linalg.cholesky((jacobian.mT @ jacobian).mean(dim=0)).mT
        return root / root.det().sqrt()


class Sphere(ClosedAnalyticSurface):
    """The unit sphere over the orbifold 2222, conformal but for the four cones.

    By default it has the radius 1/2 (the area π). The cones (0, 0), (1, 0), (1, 1), (0, 1) lie on
    the equator, at x, y, -x, -y. With theta functions of the square lattice, the quotient
    w = (θ₁/θ₃)²(πz/2), z = u + iv, is even and periodic, has one double zero at 0 and one double
    pole at 1 + i, and is ±1 at 1 and i (DLMF 20.2); inverse stereographic projection takes it to
    the sphere. Both squares are holomorphic without a common zero, so nothing is divided by zero.
    """

    name = "sphere"
    closed_domain, even = "orbifold", True

    def __init__(self, area: float | None = math.pi) -> None:
        super().__init__(area)

    def closed_point(self, u: Tensor, v: Tensor) -> Triple:
        p, q, r, s = _theta(u, v)
        zero, pole = p * p + q * q, r * r + s * s
        re, im = p * r + q * s, q * r - p * s  # θ₁ times the conjugate of θ₃
        norm = zero * zero + pole * pole
        return (
            (pole * pole - zero * zero) / norm,
            2 * (re * re - im * im) / norm,
            4 * re * im / norm,
        )


class Ellipsoid(Sphere):
    """The sphere's points, stretched to semi-axes a, b and c along x, y and z.

    The cones lie at the ends of the first two axes.

    Args:
        a, b, c: positive; only their ratios count, unless ``area`` is None.
    """

    name = "ellipsoid"
    a: float
    b: float
    c: float

    def __init__(
        self, a: float = 1.0, b: float = 0.8, c: float = 0.6, area: float | None = math.pi
    ) -> None:
        for name, axis in (("a", a), ("b", b), ("c", c)):
            self._require(0 < axis < math.inf, name, "be positive", axis)
        AnalyticSurface.__init__(self, area, a=a, b=b, c=c)

    def closed_point(self, u: Tensor, v: Tensor) -> Triple:
        x, y, z = super().closed_point(u, v)
        return self.a * x, self.b * y, self.c * z


class Torus(ClosedAnalyticSurface):
    """A torus about the z axis, over the flat torus: πu is the angle about the axis, πv the tube's.

    Args:
        major: radius of the tube's centre line.
        minor: radius of the tube, less than ``major``; only their ratio counts, unless ``area`` is
            None.
    """

    name = "torus"
    closed_domain, even = "torus", False
    major: float
    minor: float

    def __init__(
        self, major: float = 1.0, minor: float = 0.4, area: float | None = math.pi
    ) -> None:
        self._require(0 < major < math.inf, "major", "be positive", major)
        self._require(0 < minor < major, "minor", "lie between 0 and major", minor)
        super().__init__(area, major=major, minor=minor)

    def closed_point(self, u: Tensor, v: Tensor) -> Triple:
        a, b = math.pi * u, math.pi * v
        reach = self.major + self.minor * b.cos()
        return reach * a.cos(), reach * a.sin(), self.minor * b.sin()


def _theta(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Real and imaginary parts (N,) of θ₁ and of θ₃ at π(u + iv)/2, nome exp(-π), |v| ≤ 1."""
    a, b = 0.5 * math.pi * u, 0.5 * math.pi * v
    p, q, r, s = torch.zeros_like(u), torch.zeros_like(u), torch.ones_like(u), torch.zeros_like(u)
    for n in range(_TERMS):
        k, weight = 2 * n + 1, 2 * (-1) ** n * math.exp(-math.pi * (n + 0.5) ** 2)
        p = p + weight * (k * a).sin() * (k * b).cosh()
        q = q + weight * (k * a).cos() * (k * b).sinh()
        if n:
            k, weight = 2 * n, 2 * math.exp(-math.pi * n * n)
            r = r + weight * (k * a).cos() * (k * b).cosh()
            s = s - weight * (k * a).sin() * (k * b).sinh()
    return p, q, r, s


ANALYTIC.update({kind.name: kind for kind in (Sphere, Ellipsoid, Torus)})
