"""Surfaces in closed form, with closed-form Jacobians: targets that need no overfit network.

Each shape is given by its proportions, over the unit disc (or the square around it), and scaled
as a whole so that the part over the unit disc has area ``area``, π by default, as every surface
of the method has; ``area=None`` keeps the size that the formula gives.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from difflib import get_close_matches
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from nsm.errors import NsmError
from nsm.maps.expressions import Triple, parse_expression, value_and_slopes

# coordinates, and their derivatives by u and by v: each a triple of (N,)
Evaluation = tuple[Triple, Triple, Triple]


def _disc_nodes(rings: int = 128, spokes: int = 128) -> tuple[Tensor, Tensor]:
    """Points of the unit disc, each for the same share of its area, and points of its rim."""
    radius = ((torch.arange(rings, dtype=torch.float64) + 0.5) / rings).sqrt()
    angle = torch.arange(spokes, dtype=torch.float64) * (2 * math.pi / spokes)
    rim = torch.stack([angle.cos(), angle.sin()], dim=-1)
    return (radius[:, None, None] * rim).reshape(-1, 2), rim


class AnalyticSurface(nn.Module):
    """A surface Ω → R³ in closed form.

    Subclasses check their parameters, hand them to this constructor, and answer ``evaluate``.

    Args:
        area: area of the surface over the unit disc, or None for no scaling.
        **parameters: what, with the area, makes up ``config``.

    Raises:
        NsmError: the area is not positive, or the surface has no finite positive area, or its
            values and derivatives are not finite on all of the closed disc.
    """

    name: str

    def __init__(self, area: float | None, **parameters: Any) -> None:
        super().__init__()
        self.config: dict[str, Any] = {"name": self.name, **parameters, "area": area}
        self.scale = 1.0
        if area is not None and not 0 < area < math.inf:
            raise NsmError(f"{self.name}: area must be positive, or none, not {area}")
        natural = self._natural_area()
        if area is not None:
            self.scale = math.sqrt(area / natural)

    def _natural_area(self) -> float:
        inner, rim = _disc_nodes()
        nodes = torch.cat([inner, rim, torch.zeros(1, 2, dtype=inner.dtype)])
        for x in (nodes, nodes.float()):  # training runs in float32, whose range is the smaller
            value, jacobian = self.value_and_jacobian(x)
            finite = torch.cat([value, jacobian.flatten(1)], dim=1).isfinite().all(dim=1)
            if not finite.all():
                u, v = x[~finite][0].tolist()
                raise NsmError(f"{self.name}: not finite, or not smooth, at u={u:.3g}, v={v:.3g}")
        _, jacobian = self.value_and_jacobian(inner)
        columns = jacobian.unbind(dim=-1)
        area = math.pi * float(torch.linalg.cross(*columns, dim=-1).norm(dim=-1).mean())
        if not 0 < area < math.inf:
            raise NsmError(f"{self.name}: its area over the unit disc is {area}")
        return area

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        """Unscaled coordinates and their derivatives by u and by v, at u (N,) and v (N,)."""
        raise NotImplementedError

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) points of Ω to (N, 3)."""
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 3) and Jacobians (N, 3, 2), differentiable in x."""
        value, by_u, by_v = (
            torch.stack(parts, dim=-1) for parts in self.evaluate(x[..., 0], x[..., 1])
        )
        return self.scale * value, self.scale * torch.stack([by_u, by_v], dim=-1)


def _require(holds: bool, surface: str, demand: str, given: object) -> None:
    if not holds:
        raise NsmError(f"{surface}: {demand}, not {given}")


class Plane(AnalyticSurface):
    """(u, v, 0)."""

    name = "plane"

    def __init__(self, area: float | None = math.pi) -> None:
        super().__init__(area)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        one, zero = torch.ones_like(u), torch.zeros_like(u)
        return (u, v, zero), (one, zero, zero), (zero, one, zero)


class SphereCap(AnalyticSurface):
    """The part of the unit sphere within ``angle`` of its pole, by stereographic projection.

    Conformal, and smooth on the whole plane, so that points astray outside Ω do no harm. With the
    default angle and area the radius is 1.

    Args:
        angle: from the pole to the rim, in radians, in (0, π).
    """

    name = "sphere_cap"

    def __init__(self, angle: float = math.pi / 3, area: float | None = math.pi) -> None:
        _require(0 < angle < math.pi, self.name, "angle must lie between 0 and pi", angle)
        self.half_tangent = math.tan(angle / 2)
        super().__init__(area, angle=angle)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        k = self.half_tangent
        w = 2 / (1 + k * k * (u * u + v * v))
        w_u, w_v = -(k * k) * u * w * w, -(k * k) * v * w * w
        value = (k * u * w, k * v * w, w - 1)
        by_u = (k * (w + u * w_u), k * v * w_u, w_u)
        by_v = (k * u * w_v, k * (w + v * w_v), w_v)
        return value, by_u, by_v


class Cylinder(AnalyticSurface):
    """The unit disc bent, without stretch, around a cylinder along v.

    Args:
        radius: more than 1/π, or the disc would overlap itself.
    """

    name = "cylinder"

    def __init__(self, radius: float = 0.6, area: float | None = math.pi) -> None:
        _require(math.pi * radius > 1, self.name, "radius must exceed 1/pi", radius)
        self.radius = radius
        super().__init__(area, radius=radius)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        r, zero = self.radius, torch.zeros_like(u)
        sine, cosine = (u / r).sin(), (u / r).cos()
        value = (r * sine, v, r * (cosine - 1))
        return value, (cosine, zero, -sine), (zero, torch.ones_like(u), zero)


class Cone(AnalyticSurface):
    """(u, v, −slope·√(u² + v² + tip²)): a cone with its apex, rounded, over the centre.

    Args:
        slope: height over radius.
        tip: radius of the rounding, positive; a true apex has no derivative.
    """

    name = "cone"

    def __init__(self, slope: float = 1.0, tip: float = 0.05, area: float | None = math.pi) -> None:
        _require(0 < tip < math.inf, self.name, "tip must be positive", tip)
        self.slope, self.tip = slope, tip
        super().__init__(area, slope=slope, tip=tip)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        one, zero = torch.ones_like(u), torch.zeros_like(u)
        r = (u * u + v * v + self.tip**2).sqrt()
        value = (u, v, -self.slope * r)
        return value, (one, zero, -self.slope * u / r), (zero, one, -self.slope * v / r)


class Quadric(AnalyticSurface):
    """(u, v, curvature·(u² ± v²)): a paraboloid, or a saddle.

    Args:
        curvature: how fast it leaves the plane; zero is the plane.
    """

    sign: float

    def __init__(self, curvature: float = 0.5, area: float | None = math.pi) -> None:
        self.curvature = curvature
        super().__init__(area, curvature=curvature)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        one, zero = torch.ones_like(u), torch.zeros_like(u)
        a, b = self.curvature, self.sign * self.curvature
        value = (u, v, a * u * u + b * v * v)
        return value, (one, zero, 2 * a * u), (zero, one, 2 * b * v)


class Paraboloid(Quadric):
    __doc__ = Quadric.__doc__
    name, sign = "paraboloid", 1.0


class Saddle(Quadric):
    __doc__ = Quadric.__doc__
    name, sign = "saddle", -1.0


class TorusPatch(AnalyticSurface):
    """A patch around the outermost point of a torus.

    Args:
        minor: radius of the tube, in (0, 1); that of its centre line is 1.
        sweep: angle about the axis that u = 1 reaches, in (0, π].
        tube: angle about the tube that v = 1 reaches, in (0, π].
    """

    name = "torus_patch"

    def __init__(
        self,
        minor: float = 0.4,
        sweep: float = 1.0,
        tube: float = 2.0,
        area: float | None = math.pi,
    ) -> None:
        _require(0 < minor < 1, self.name, "minor must lie between 0 and 1", minor)
        _require(0 < sweep <= math.pi, self.name, "sweep must lie between 0 and pi", sweep)
        _require(0 < tube <= math.pi, self.name, "tube must lie between 0 and pi", tube)
        self.minor, self.sweep, self.tube = minor, sweep, tube
        super().__init__(area, minor=minor, sweep=sweep, tube=tube)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        r, a, b = self.minor, self.sweep, self.tube
        sine_u, cosine_u = (a * u).sin(), (a * u).cos()
        sine_v, cosine_v = (b * v).sin(), (b * v).cos()
        reach, reach_v = 1 + r * cosine_v, -r * b * sine_v
        value = (reach * cosine_u, reach * sine_u, r * sine_v)
        by_u = (-a * reach * sine_u, a * reach * cosine_u, torch.zeros_like(u))
        by_v = (reach_v * cosine_u, reach_v * sine_u, r * b * cosine_v)
        return value, by_u, by_v


class MobiusGraph(AnalyticSurface):
    """A patch of a Möbius band: a strip around a unit circle that turns as it goes.

    Args:
        width: half width of the strip, in (0, 1).
        sweep: angle along the circle that u = 1 reaches, in (0, π].
        twist: turns of the strip per turn of the circle; 1/2 is Möbius's.
    """

    name = "mobius_graph"

    def __init__(
        self,
        width: float = 0.6,
        sweep: float = 2.0,
        twist: float = 0.5,
        area: float | None = math.pi,
    ) -> None:
        _require(0 < width < 1, self.name, "width must lie between 0 and 1", width)
        _require(0 < sweep <= math.pi, self.name, "sweep must lie between 0 and pi", sweep)
        self.width, self.sweep, self.twist = width, sweep, twist
        super().__init__(area, width=width, sweep=sweep, twist=twist)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        w, a, b = self.width, self.sweep, self.sweep * self.twist
        sine, cosine = (a * u).sin(), (a * u).cos()
        tilt_sine, tilt_cosine = (b * u).sin(), (b * u).cos()
        reach, reach_u, reach_v = 1 + w * v * tilt_cosine, -w * b * v * tilt_sine, w * tilt_cosine
        value = (reach * cosine, reach * sine, w * v * tilt_sine)
        by_u = (
            reach_u * cosine - a * reach * sine,
            reach_u * sine + a * reach * cosine,
            w * b * v * tilt_cosine,
        )
        return value, by_u, (reach_v * cosine, reach_v * sine, w * tilt_sine)


class Graph(AnalyticSurface):
    """(u, v, z(u, v)) with z given as text, such as ``0.3*sin(3*u)*v``.

    Args:
        z: see :func:`nsm.maps.expressions.parse_expression` for what it may hold; finite and
            smooth on the closed disc.

    Raises:
        NsmError: ``z`` is not such an expression.
    """

    name = "graph"

    def __init__(self, z: str, area: float | None = math.pi) -> None:
        _require(isinstance(z, (str, int, float)), self.name, "z must be an expression", z)
        self._tree = parse_expression(str(z))
        try:
            super().__init__(area, z=str(z))
        except (ArithmeticError, ValueError):
            raise NsmError(f"graph {z!r}: a constant is not finite, or too large") from None

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        one, zero = torch.ones_like(u), torch.zeros_like(u)
        z, z_u, z_v = value_and_slopes(self._tree, u, v)
        return (u, v, z), (one, zero, z_u), (zero, one, z_v)


class Formula(AnalyticSurface):
    """(x, y, z) by a function of u and v, differentiated by PyTorch's forward mode.

    Args:
        name: what the surface is called.
        function: u (N,), v (N,) and parameters to three coordinates (N,), each point's of its own
            u and v alone; finite and smooth on the closed disc.
        **parameters: of the function.

    Raises:
        NsmError: the function takes no such parameters, or gives no surface.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Triple],
        area: float | None = math.pi,
        **parameters: Any,
    ) -> None:
        try:
            inspect.signature(function).bind(None, None, **parameters)
        except TypeError as error:
            raise NsmError(f"{name}: {error}") from None
        self.name, self._point = name, partial(function, **parameters)
        super().__init__(area, **parameters)

    def evaluate(self, u: Tensor, v: Tensor) -> Evaluation:
        one, zero = torch.ones_like(u), torch.zeros_like(u)
        along_u = torch.func.jvp(self._on_all, (u, v), (one, zero))
        along_v = torch.func.jvp(self._on_all, (u, v), (zero, one))
        return along_u[0], along_u[1], along_v[1]

    def _on_all(self, u: Tensor, v: Tensor) -> Triple:
        x, y, z = (torch.as_tensor(c, dtype=u.dtype) + 0 * u for c in self._point(u, v))
        return x, y, z


ANALYTIC: dict[str, Callable[..., AnalyticSurface]] = {
    kind.name: kind
    for kind in (
        Plane,
        SphereCap,
        Cylinder,
        Cone,
        Paraboloid,
        Saddle,
        TorusPatch,
        MobiusGraph,
        Graph,
    )
}


def build_analytic(config: dict[str, Any]) -> AnalyticSurface:
    """The surface that a configuration names.

    Args:
        config: ``{"name": ..., parameters}``, as ``AnalyticSurface.config`` gives it.

    Raises:
        NsmError: the name or a parameter is not known, is missing, or has no good value.
    """
    parameters = dict(config)
    name = parameters.pop("name", None)
    if name not in ANALYTIC:
        nearest = get_close_matches(str(name), ANALYTIC, n=1, cutoff=0.0)[0]
        raise NsmError(
            f"analytic surface {name!r} is not known: did you mean {nearest!r}? "
            f"known are {', '.join(ANALYTIC)}"
        )
    kind = ANALYTIC[name]
    try:
        inspect.signature(kind).bind(**parameters)
    except TypeError as error:
        raise NsmError(f"{name}: {error}") from None
    try:
        return kind(**parameters)
    except (TypeError, ArithmeticError):
        raise NsmError(f"{name}: a parameter is not a fit number in {parameters}") from None
