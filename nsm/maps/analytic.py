"""Surfaces in closed form: targets that need no overfit network.

Each shape is a function of (u, v), over the unit disc (or the square around it), that PyTorch
differentiates in forward mode; :mod:`nsm.maps.analytic_closed` has those over closed domains. It is
scaled as a whole so that the part over the unit disc has area ``area``, π by default, as every
surface of the method has; ``area=None`` keeps the size that the formula gives.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from nsm.errors import NsmError
from nsm.instantiation import instantiate_stored, target_of
from nsm.maps.encodings import Identity, pushed_forward
from nsm.maps.expressions import evaluate, parse_expression

Triple = tuple[Tensor, Tensor, Tensor]  # coordinates, each (N,)


def _disc_nodes(rings: int = 128, spokes: int = 128) -> tuple[Tensor, Tensor]:
    """Points of the unit disc, each for the same share of its area, and points of its rim."""
    radius = ((torch.arange(rings, dtype=torch.float64) + 0.5) / rings).sqrt()
    angle = torch.arange(spokes, dtype=torch.float64) * (2 * math.pi / spokes)
    rim = torch.stack([angle.cos(), angle.sin()], dim=-1)
    return (radius[:, None, None] * rim).reshape(-1, 2), rim


class AnalyticSurface(nn.Module):
    """A surface Ω → R³ in closed form.

    Subclasses check their parameters, hand them to this constructor, which keeps them as
    attributes, and answer ``point``.

    Args:
        area: area of the surface over Ω (the unit disc, if it is not closed), or None for no
            scaling.
        **parameters: of the shape.

    Attributes:
        config: settings from which :func:`build_analytic` makes the surface again.

    Raises:
        NsmError: the area is not positive, or the surface has no finite positive area, or its
            values and derivatives are not finite on all of Ω.
    """

    name: str
    closed_domain: ClassVar[str | None] = None  # the one domain of a closed surface, by its name

    def __init__(self, area: float | None, **parameters: Any) -> None:
        super().__init__()
        self.config = {"_target_": target_of(type(self)), **parameters, "area": area}
        for key, value in parameters.items():
            setattr(self, key, value)
        self.scale = 1.0
        self._require(area is None or 0 < area < math.inf, "area", "be positive, or none", area)
        natural = self._natural_area()
        if area is not None:
            self.scale = math.sqrt(area / natural)

    def _require(self, holds: bool, parameter: str, demand: str, given: object) -> None:
        if not holds:
            message = f"{self.name}: {parameter} must {demand}, not {given}"
            raise NsmError(message, kind="out_of_range", key=parameter)

    def _natural_area(self) -> float:
        inner, further, measure = self._nodes()
        nodes = torch.cat([inner, further])
        for x in (nodes, nodes.float()):  # training runs in float32, whose range is the smaller
            value, jacobian = self.value_and_jacobian(x)
            finite = torch.cat([value, jacobian.flatten(1)], dim=1).isfinite().all(dim=1)
            if not finite.all():
                u, v = x[~finite][0].tolist()
                message = f"{self.name}: not finite, or not smooth, at u={u:.3g}, v={v:.3g}"
                raise NsmError(message, kind="not_finite", key=self.name)
        _, jacobian = self.value_and_jacobian(inner)
        columns = jacobian.unbind(dim=-1)
        area = measure * float(torch.linalg.cross(*columns, dim=-1).norm(dim=-1).mean())
        if not 0 < area < math.inf:
            message = f"{self.name}: its area is {area}"
            raise NsmError(message, kind="out_of_range", key=self.name)
        return area

    def _nodes(self) -> tuple[Tensor, Tensor, float]:
        """Points (N, 2) of Ω, each for the same share of it; further ones to check; Ω's area."""
        inner, rim = _disc_nodes()
        return inner, torch.cat([rim, torch.zeros(1, 2, dtype=rim.dtype)]), math.pi

    def point(self, u: Tensor, v: Tensor) -> Triple:
        """Unscaled coordinates, each (N,), at u (N,) and v (N,)."""
        raise NotImplementedError

    def forward(self, x: Tensor) -> Tensor:
        """(N, 2) points of Ω to (N, 3)."""
        return self.scale * torch.stack(self.point(x[..., 0], x[..., 1]), dim=-1)

    def value_and_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 2) to the values (N, 3) and Jacobians (N, 3, 2), differentiable in x."""
        stack = pushed_forward(self, Identity().value_and_jacobian_stack(x))
        return stack[0], stack[1:].permute(1, 2, 0)


class Plane(AnalyticSurface):
    """(u, v, 0)."""

    name = "plane"

    def __init__(self, area: float | None = math.pi) -> None:
        super().__init__(area)

    def point(self, u: Tensor, v: Tensor) -> Triple:
        return u, v, torch.zeros_like(u)


class SphereCap(AnalyticSurface):
    """The part of the unit sphere within ``angle`` of its pole, by stereographic projection.

    Conformal, and smooth on the whole plane, so that points outside Ω do no harm. With the
    default angle and area the radius is 1.

    Args:
        angle: from the pole to the rim, in radians, in (0, π).
    """

    name = "sphere_cap"
    angle: float

    def __init__(self, angle: float = math.pi / 3, area: float | None = math.pi) -> None:
        self._require(0 < angle < math.pi, "angle", "lie between 0 and pi", angle)
        super().__init__(area, angle=angle)

    def point(self, u: Tensor, v: Tensor) -> Triple:
        k = math.tan(self.angle / 2)
        w = 2 / (1 + k * k * (u * u + v * v))
        return k * u * w, k * v * w, w - 1


class Cylinder(AnalyticSurface):
    """The unit disc bent, without stretch, around a cylinder along v.

    Args:
        radius: more than 1/π, or the disc would overlap itself.
    """

    name = "cylinder"
    radius: float

    def __init__(self, radius: float = 0.6, area: float | None = math.pi) -> None:
        self._require(math.pi * radius > 1, "radius", "exceed 1/pi", radius)
        super().__init__(area, radius=radius)

    def point(self, u: Tensor, v: Tensor) -> Triple:
        r = self.radius
        return r * (u / r).sin(), v, r * ((u / r).cos() - 1)


class Cone(AnalyticSurface):
    """(u, v, −slope·√(u² + v² + tip²)): a cone with its apex, rounded, over the centre.

    Args:
        slope: height over radius.
        tip: radius of the rounding, positive; a true apex has no derivative.
    """

    name = "cone"
    slope: float
    tip: float

    def __init__(self, slope: float = 1.0, tip: float = 0.05, area: float | None = math.pi) -> None:
        self._require(0 < tip < math.inf, "tip", "be positive", tip)
        super().__init__(area, slope=slope, tip=tip)

    def point(self, u: Tensor, v: Tensor) -> Triple:
        return u, v, -self.slope * (u * u + v * v + self.tip**2).sqrt()


class Quadric(AnalyticSurface):
    """(u, v, curvature·(u² ± v²)): a paraboloid, or a saddle.

    Args:
        curvature: how fast it leaves the plane; zero is the plane.
    """

    sign: float
    curvature: float

    def __init__(self, curvature: float = 0.5, area: float | None = math.pi) -> None:
        super().__init__(area, curvature=curvature)

    def point(self, u: Tensor, v: Tensor) -> Triple:
        a, b = self.curvature, self.sign * self.curvature
        return u, v, a * u * u + b * v * v


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
    minor: float
    sweep: float
    tube: float

    def __init__(
        self,
        minor: float = 0.4,
        sweep: float = 1.0,
        tube: float = 2.0,
        area: float | None = math.pi,
    ) -> None:
        self._require(0 < minor < 1, "minor", "lie between 0 and 1", minor)
        self._require(0 < sweep <= math.pi, "sweep", "lie between 0 and pi", sweep)
        self._require(0 < tube <= math.pi, "tube", "lie between 0 and pi", tube)
        super().__init__(area, minor=minor, sweep=sweep, tube=tube)

    def point(self, u: Tensor, v: Tensor) -> Triple:
        r, a, b = self.minor, self.sweep, self.tube
        reach = 1 + r * (b * v).cos()
        return reach * (a * u).cos(), reach * (a * u).sin(), r * (b * v).sin()


class MobiusGraph(AnalyticSurface):
    """A patch of a Möbius band: a strip around a unit circle that turns as it goes.

    Args:
        width: half width of the strip, in (0, 1).
        sweep: angle along the circle that u = 1 reaches, in (0, π].
        twist: turns of the strip per turn of the circle; 1/2 is Möbius's.
    """

    name = "mobius_graph"
    width: float
    sweep: float
    twist: float

    def __init__(
        self,
        width: float = 0.6,
        sweep: float = 2.0,
        twist: float = 0.5,
        area: float | None = math.pi,
    ) -> None:
        self._require(0 < width < 1, "width", "lie between 0 and 1", width)
        self._require(0 < sweep <= math.pi, "sweep", "lie between 0 and pi", sweep)
        super().__init__(area, width=width, sweep=sweep, twist=twist)

    def point(self, u: Tensor, v: Tensor) -> Triple:
        w, a, b = self.width, self.sweep, self.sweep * self.twist
        reach = 1 + w * v * (b * u).cos()
        return reach * (a * u).cos(), reach * (a * u).sin(), w * v * (b * u).sin()


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
        self._require(isinstance(z, (str, int, float)), "z", "be an expression", z)
        self._tree = parse_expression(str(z))
        try:
            super().__init__(area, z=str(z))
        except (ArithmeticError, ValueError):
            message = f"graph {z!r}: a constant is not finite, or too large"
            raise NsmError(message, kind="out_of_range", key="z") from None

    def point(self, u: Tensor, v: Tensor) -> Triple:
        return u, v, evaluate(self._tree, u, v)


class Formula(AnalyticSurface):
    """(x, y, z) by a function of u and v.

    Args:
        name: of the surface.
        function: u (N,), v (N,) and parameters to three coordinates (N,), each from its own
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
            raise NsmError(f"{name}: {error}", kind="unknown_setting", key=name) from None
        self.name, self._function = name, partial(function, **parameters)
        super().__init__(area)
        # the name is registered; the function has no other address
        self.config = {"name": name, **parameters, "area": area}

    def point(self, u: Tensor, v: Tensor) -> Triple:
        x, y, z = (torch.as_tensor(c, dtype=u.dtype) + 0 * u for c in self._function(u, v))
        return x, y, z


_KINDS = (Plane, SphereCap, Cylinder, Cone, Paraboloid, Saddle, TorusPatch, MobiusGraph, Graph)
# by name; the closed ones and users' own are added to it
ANALYTIC: dict[str, Callable[..., AnalyticSurface]] = {kind.name: kind for kind in _KINDS}


def build_analytic(config: Mapping[str, Any], trust: Iterable[str] = ()) -> AnalyticSurface:
    """The surface that settings name.

    Args:
        config: ``{"name": ..., parameters}``, or ``AnalyticSurface.config``, whose ``_target_`` is
            a class.
        trust: modules other than nsm that this class may come from.

    Raises:
        NsmError: the name or a parameter is not known, is missing, or is out of range.
        NotTrusted: the class is in another module.
    """
    parameters = dict(config)
    target = parameters.pop("_target_", None)
    known = {target_of(kind): name for name, kind in ANALYTIC.items() if inspect.isclass(kind)}
    name = known.get(target)
    if target is not None and name is None:
        surface = instantiate_stored(config, trust=trust)
        if not isinstance(surface, AnalyticSurface):
            raise NsmError(f"{target} is no analytic surface", kind="wrong_type", key=target)
        return surface
    name = parameters.pop("name", name)
    if name not in ANALYTIC:
        nearest = get_close_matches(str(name), ANALYTIC, n=1, cutoff=0.0)[0]
        raise NsmError(
            f"analytic surface {name!r} is not known: did you mean {nearest!r}? "
            f"known are {', '.join(ANALYTIC)}",
            kind="unknown_option",
            key="name",
        )
    kind = ANALYTIC[name]
    try:
        inspect.signature(kind).bind(**parameters)
    except TypeError as error:
        raise NsmError(f"{name}: {error}", kind="unknown_setting", key=name) from None
    try:
        return kind(**parameters)
    except (TypeError, ArithmeticError):
        message = f"{name}: a parameter is not a suitable number in {parameters}"
        raise NsmError(message, kind="wrong_type", key=name) from None
