"""Your own activations, encodings, energies, blocks and analytic targets, under short names.

A class in a module of yours needs no registration: ``activation._target_=mypackage.MyActivation``.
These functions are the short way for notebooks. What is registered is there for the Python process
that registered it; saved files name it as ``nsm.extensions.registered.NAME``, and loading them
needs the registration again.
"""

from __future__ import annotations

import copy
import functools
import inspect
import re
import sys
import types
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from hydra.core.config_store import ConfigStore
from torch import Tensor, nn

from nsm.energies import Invariants
from nsm.energies.distortion import of_invariants
from nsm.errors import NsmError
from nsm.maps import ANALYTIC, BLOCKS, Formula


def _not_registered(name: str) -> Any:
    message = "is not registered in this process; if it is yours, call nsm.register_... first"
    raise AttributeError(f"{name!r} {message}")


# a module of its own, so that ``_target_`` can name what is in it
registered = types.ModuleType(f"{__name__}.registered")
registered.__getattr__ = _not_registered  # type: ignore[method-assign]
sys.modules[registered.__name__] = registered

_NAME = re.compile(r"[a-z][a-z0-9_]*")
_KINDS: dict[str, str] = {}  # of each registered name


def register_energy(name: str, formula: Callable[[Invariants], Tensor]) -> None:
    """Make a distortion energy known as ``energy=NAME``.

    Args:
        name: lower case letters, digits and underscores.
        formula: from the invariants of M = A⁻¹B, ``m.trace`` = σ₁² + σ₂² and ``m.determinant`` =
            σ₁²σ₂², each (...) in float64, to the energy (...), differentiable.

    Raises:
        NsmError: a name that is taken or no name, or a formula that gives something else.

    Examples:
        >>> nsm.register_energy("stretch", lambda m: m.trace + 1 / (m.determinant + 1e-6))
        >>> nsm.map_pair(a, b, landmarks, energy="stretch")
    """
    energy = of_invariants(formula)
    same = torch.eye(2).expand(3, 2, 2)
    value = energy(same, same)
    if value.shape != (3,) or not bool(value.isfinite().all()):
        raise NsmError(
            f"energy {name!r}: it must give one finite number for each sample at an isometry",
            kind="wrong_shape",
            key=name,
        )
    _register("energy", name, lambda: energy)


def register_activation(name: str, function: Callable[..., Any] | nn.Module) -> None:
    """Make an activation known as ``activation=NAME``; PyTorch differentiates it.

    Args:
        name: lower case letters, digits and underscores.
        function: z (...) to f(z) (...), entry by entry, of PyTorch's functions, further arguments
            of which are settings with defaults; or a module; or a class of modules.

    Raises:
        NsmError: a name that is taken or no name, or further arguments without defaults.

    Examples:
        >>> nsm.register_activation("swish", lambda z, beta=1.5: z * torch.sigmoid(beta * z))
        >>> nsm.overfit(surface, activation={"_target_": "nsm.extensions.registered.swish"})
    """
    if isinstance(function, nn.Module):
        _register("activation", name, lambda: copy.deepcopy(function))
    elif inspect.isclass(function):
        _register("activation", name, function)
    else:
        _register("activation", name, _maker_of(name, function))


def _maker_of(name: str, function: Callable[..., Tensor]) -> Callable[..., Callable[..., Tensor]]:
    """From the settings of an activation that is a function to a function of z alone."""

    def make(**settings: Any) -> Callable[..., Tensor]:
        return partial(function, **settings)

    try:
        parameters = list(inspect.signature(function).parameters.values())[1:]
    except ValueError:  # torch.sin and others in C have no signature
        parameters = []
    for parameter in parameters:
        if not isinstance(parameter.default, (int, float)):
            raise NsmError(
                f"activation {name!r}: {parameter.name} needs a number as its default",
                kind="missing_default",
                key=name,
            )
    only = [p.replace(kind=p.KEYWORD_ONLY) for p in parameters]
    make.__signature__ = inspect.Signature(only)  # type: ignore[attr-defined]
    return make


def register_encoding(name: str, kind: Callable[..., Any]) -> None:
    """Make an encoding known as ``encoding=NAME``: what the network sees of a point (u, v).

    Args:
        name: lower case letters, digits and underscores.
        kind: called with its settings, gives a module with ``out_dim``, from points (N, 2) to
            features (N, out_dim), each row from its own point alone. PyTorch finds its Jacobian,
            unless it has a method ``value_and_jacobian_stack`` (see :class:`nsm.maps.SplineGrid`).

    Raises:
        NsmError: a name that is taken or no name.
    """
    # as for those of conf/: what has no grid to fit is trained from a random start
    start = {"override /initialization@_global_.initialization": "random"}
    _register("encoding", name, kind, {"defaults": [start, "_self_"]})


def register_block(name: str, kind: Callable[[int, nn.Module], nn.Module]) -> None:
    """Make a network known as ``map.block=NAME``: ``map.depth`` such blocks in sequence.

    Between the encoding and the blocks stands a linear layer with the activation, behind them a
    linear layer.

    Args:
        name: lower case letters, digits and underscores.
        kind: called with ``map.width`` and the activation, gives a module (N, width) to
            (N, width), each row from its own row alone. PyTorch finds its Jacobian.

    Raises:
        NsmError: a name that is taken or no name.
    """
    _take("block", name, BLOCKS)
    BLOCKS[name] = kind


def register_analytic(name: str, function: Callable[..., tuple[Tensor, Tensor, Tensor]]) -> None:
    """Make a surface in closed form known as ``target=NAME``.

    Args:
        name: lower case letters, digits and underscores.
        function: u (N,) and v (N,) to the three coordinates (N,), of PyTorch's functions, each
            point from its own u and v alone; finite and smooth on Ω. Further arguments are
            parameters: ``target='{name: NAME, PARAMETER: VALUE}'``.

    Raises:
        NsmError: a name that is taken or no name.

    Examples:
        >>> nsm.register_analytic("dune", lambda u, v, height=0.3: (u, v, height * (3 * u).sin()))
        >>> nsm.map_pair(phi, {"name": "dune", "height": 0.5})
    """
    _take("analytic surface", name, ANALYTIC)
    ANALYTIC[name] = partial(Formula, name, function)


def _register(
    group: str, name: str, make: Callable[..., Any], node: dict[str, Any] | None = None
) -> None:
    """Make ``GROUP=NAME`` an option, as a file of conf/ does, whose ``_target_`` is ``make``."""
    _take(group, name, known=())

    @functools.wraps(make)
    def target(*args: Any, **kwargs: Any) -> Any:
        return make(*args, **kwargs)

    # its home is here, so that stored files that name it are trusted
    target.__module__, target.__qualname__ = registered.__name__, name
    setattr(registered, name, target)
    store = {**(node or {}), "_target_": f"{registered.__name__}.{name}"}
    ConfigStore.instance().store(group=group, name=name, node=store, provider="nsm")


def _take(kind: str, name: str, known: Any) -> None:
    """Take a name for a kind; one that is taken for it may be registered again, as notebooks do."""
    if not _NAME.fullmatch(name):
        raise NsmError(
            f"{kind} {name!r}: a name is lower case letters, digits and underscores",
            kind="invalid_name",
            key=name,
        )
    from nsm.config import conf_folder

    builtin = (conf_folder() / kind / f"{name}.yaml").is_file() or name in known
    if _KINDS.get(name, kind) != kind or (builtin and name not in _KINDS):
        raise NsmError(
            f"{kind} {name!r} exists already; take another name", kind="name_taken", key=name
        )
    _KINDS[name] = kind
