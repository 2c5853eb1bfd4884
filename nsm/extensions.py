"""One's own energies, activations, encodings, blocks and analytic targets, under names.

What is registered is there for the Python process that registered it, wherever a setting or a
saved file names it; settings and files hold names alone, and never say what to import.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, MutableMapping
from functools import partial
from typing import Any

import torch
from hydra.core.config_store import ConfigStore
from torch import Tensor, nn

from nsm.energies import ENERGIES, Invariants
from nsm.energies.distortion import of_invariants
from nsm.errors import NsmError
from nsm.maps import ACTIVATIONS, ANALYTIC, BLOCKS, ENCODINGS, Activation, Encoding, Formula
from nsm.maps.activations import elementwise

_NAME = re.compile(r"[a-z][a-z0-9_]*")
_OWN: set[tuple[str, str]] = set()  # kind and name


def register_energy(name: str, formula: Callable[[Invariants], Tensor]) -> None:
    """Make a distortion energy known as ``energy=NAME`` and ``energy.weights.NAME``.

    Args:
        name: lower case letters, digits and underscores.
        formula: from the invariants of M = A⁻¹B, ``m.trace`` = σ₁² + σ₂² and ``m.determinant`` =
            σ₁²σ₂², each (...) in float64, to the energy (...), differentiable.

    Raises:
        NsmError: a name that is taken or no name, or a formula that gives something else.

    Examples:
        >>> nsm.register_energy("stretch", lambda m: m.trace + 1 / (m.determinant + 1e-6))
        >>> nsm.map_pair(a, b, landmarks, overrides=["energy=stretch"])
    """
    energy = of_invariants(formula)
    same = torch.eye(2).expand(3, 2, 2)
    value = energy(same, same)
    if value.shape != (3,) or not bool(value.isfinite().all()):
        raise NsmError(f"energy {name!r}: it must give one finite number a sample at an isometry")
    _add("energy", name, ENERGIES, energy)
    _offer("energy", name, {"weights": {name: 1.0}})


def register_activation(name: str, function: Callable[..., Tensor]) -> None:
    """Make an activation known as ``activation=NAME``; PyTorch finds f′ and f″.

    Args:
        name: lower case letters, digits and underscores.
        function: z (...) to f(z) (...), entry by entry, made of PyTorch's functions. Further
            arguments are settings: numbers, not negative, with defaults.

    Raises:
        NsmError: a name that is taken or no name, or further arguments without defaults.

    Examples:
        >>> nsm.register_activation("swish", lambda z, beta=1.5: z * torch.sigmoid(beta * z))
        >>> nsm.overfit(surface, overrides=["activation=swish", "activation.beta=2"])
    """
    settings = list(inspect.signature(function).parameters.values())[1:]
    for parameter in settings:
        if not isinstance(parameter.default, (int, float)):
            raise NsmError(f"activation {name!r}: {parameter.name} needs a number as its default")
    defaults = {parameter.name: float(parameter.default) for parameter in settings}
    _add("activation", name, ACTIVATIONS, elementwise(function, defaults))
    _offer("activation", name, {"name": name, **defaults})


def register_encoding(name: str, kind: Callable[..., Encoding]) -> None:
    """Make an encoding known as ``encoding=NAME``: what the network sees of a point (u, v).

    Args:
        name: lower case letters, digits and underscores.
        kind: called with 2, the dimension of Ω, and its settings, gives a module with
            ``out_dim``, from points (N, 2) to features (N, out_dim), each row of its own point
            alone. Its Jacobian is found by PyTorch, unless it has a method
            ``value_and_jacobian_stack`` (see :class:`nsm.maps.SplineGrid`).

    Raises:
        NsmError: a name that is taken or no name.
    """
    given = list(inspect.signature(kind).parameters.values())[1:]
    settings = {p.name: p.default for p in given if p.default is not inspect.Parameter.empty}
    _add("encoding", name, ENCODINGS, kind)
    # as for those of conf/: what has no grid to fit is trained from a random start
    start = {"override /initialization@_global_.initialization": "random"}
    _offer("encoding", name, {"defaults": [start, "_self_"], "name": name, **settings})


def register_block(name: str, kind: Callable[[int, Activation], nn.Module]) -> None:
    """Make a network known as ``map.block=NAME``: ``map.depth`` such blocks, one after the other.

    Between the encoding and the blocks stands a linear layer with the activation, behind them a
    linear layer.

    Args:
        name: lower case letters, digits and underscores.
        kind: called with ``map.width`` and the activation, gives a module (N, width) to
            (N, width), each row of its own row alone. Its Jacobian is found by PyTorch.

    Raises:
        NsmError: a name that is taken or no name.
    """
    _add("block", name, BLOCKS, kind)


def register_analytic(name: str, function: Callable[..., tuple[Tensor, Tensor, Tensor]]) -> None:
    """Make a surface in closed form known as ``target=NAME``.

    Args:
        name: lower case letters, digits and underscores.
        function: u (N,) and v (N,) to the three coordinates (N,), made of PyTorch's functions,
            each point's of its own u and v alone; finite and smooth on Ω. Further arguments are
            parameters: ``target='{name: NAME, PARAMETER: VALUE}'``.

    Raises:
        NsmError: a name that is taken or no name.

    Examples:
        >>> nsm.register_analytic("dune", lambda u, v, height=0.3: (u, v, height * (3 * u).sin()))
        >>> nsm.map_pair(phi, {"name": "dune", "height": 0.5})
    """
    _add("analytic surface", name, ANALYTIC, partial(Formula, name, function))


def _add(kind: str, name: str, table: MutableMapping[str, Any], thing: Any) -> None:
    """Put a thing into a table; one of the user's own may be put there again, as notebooks do."""
    if not _NAME.fullmatch(name):
        raise NsmError(f"{kind} {name!r}: a name is lower case letters, digits and underscores")
    if name in table and (kind, name) not in _OWN:
        raise NsmError(f"{kind} {name!r} is there already; take another name")
    table[name] = thing
    _OWN.add((kind, name))


def _offer(group: str, name: str, settings: Mapping[str, Any]) -> None:
    """Make ``GROUP=NAME`` an option, as a file of conf/ does."""
    ConfigStore.instance().store(group=group, name=name, node=dict(settings))
