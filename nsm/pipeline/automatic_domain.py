"""domain=auto: the domain of a run, from its inputs and settings."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig
from rich.console import Console

from nsm.domains import Automatic, Domain, Surface, domain
from nsm.domains.automatic import is_part_of_whole
from nsm.domains.joint_preparation import check_common_topology
from nsm.domains.orbifold.domain import ClosedDomain
from nsm.errors import NsmError
from nsm.instantiation import made
from nsm.maps import ANALYTIC, build_analytic
from nsm.pipeline.configured_surface import configured_repairs
from nsm.results import NeuralSurface, load_surface
from nsm.results.artifact import is_stored_surface
from nsm.surfaces.given import given_mesh
from nsm.surfaces.topology import genus_and_boundary
from nsm.surfaces.validation import clean


def is_automatic(config: Any) -> bool:
    """Whether the settings of the group ``domain`` leave the choice open."""
    return str(config.get("_target_", "")).rpartition(".")[2] == Automatic.__name__


def choose_domain(
    config: DictConfig,
    inputs: Iterable[Any],
    console: Console,
    *,
    closed: bool,
    parts: bool = False,
) -> Domain:
    """The domain that suits a run, which takes the place of ``auto`` in its settings.

    Ready surfaces lie on a domain already, and so do analytic ones. Meshes take the one of their
    topology, unless a setting needs a boundary or cannot be made periodic.

    Args:
        config: of the run; ``domain`` is replaced.
        inputs: ready surfaces, meshes and analytic surfaces, as
            :func:`nsm.pipeline.resolve_inputs.read_shape` takes them.
        console: where the choice is told.
        closed: whether the task can do without a boundary.
        parts: whether it takes the first input, a part, into the second, a whole shape.

    Raises:
        NsmError: a mesh that cannot be read; ``wrong_topology``: of another genus than a closed
            surface that is ready or analytic, or with a boundary.
    """
    found: Domain | None = None
    topologies, names = [], []
    for given in inputs:
        own, topology = _told_by(given, config)
        found = found or own
        if topology is not None:
            topologies.append(topology)
            names.append(Path(given).stem if isinstance(given, (str, Path)) else "the mesh")
    into = parts and is_part_of_whole(topologies)
    if into:  # the part is closed for the map
        topologies, names = topologies[1:], names[1:]
    if found is None:
        chosen = made(config.domain).chosen(topologies) if topologies else domain("disc")
        found = chosen if closed and _suits(config, chosen) else domain("disc")
        if not found.has_boundary and not into:
            console.print(f"domain={found}: closed surfaces of genus {topologies[0][0]}, no seam")
    elif isinstance(found, ClosedDomain):
        wanted = (0 if found.even else 1, 0)
        if not (parts and is_part_of_whole([*topologies, wanted])):
            ready = f"the closed surface on the {found}"
            check_common_topology([ready, *names], [wanted, *topologies])
    config.domain = found.config
    return found


def _told_by(given: Any, config: DictConfig) -> tuple[Domain | None, tuple[int, int] | None]:
    """The domain of an input that has one, or its genus and number of boundary loops."""
    if isinstance(given, NeuralSurface):
        return given.surface.domain, None
    if isinstance(given, Surface):
        return given.domain, None
    if isinstance(given, dict):
        return _analytic(given), None
    if given is None:
        return None, None  # refused where it is read
    name = str(given) if isinstance(given, (str, Path)) else ""
    if name and is_stored_surface(name):
        return load_surface(name, trust=config.trust).surface.domain, None
    if name in ANALYTIC and name == str(config.get("target")):
        return _analytic({"name": name}), None
    mesh = given_mesh(given)
    repairs = configured_repairs(config)
    return None, genus_and_boundary(clean(mesh.vertices, mesh.faces, mesh.name, repairs).faces)


def _analytic(given: dict[str, Any]) -> Domain | None:
    own = getattr(build_analytic(given), "closed_domain", None)
    return domain(own or "disc")


def _suits(config: DictConfig, chosen: Domain) -> bool:
    """Whether the settings work on a domain without boundary, if it is one."""
    if chosen.has_boundary:
        return True
    needs_boundary = (
        config.surface.seam_vertices is not None,
        config.surface.parameterization != "slim",
        config.get("seam") is not None
        and (config.seam.landmarks is not None or config.seam.path != "auto"),
        config.get("constraints") is not None and config.constraints.get("boundary") == "penalty",
    )
    if any(needs_boundary):
        return False
    try:
        chosen.encoding(config.encoding)
    except NsmError:
        return False
    return True
