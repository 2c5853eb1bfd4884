"""The domains by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from nsm.domains.base import BoundedDomain, Domain
from nsm.domains.disc import Disc
from nsm.domains.orbifold.domain import Orbifold, Torus
from nsm.domains.square import Square
from nsm.errors import NsmError

DOMAINS: dict[str, Domain] = {kind.name: kind() for kind in (Disc, Square, Orbifold, Torus)}


def domain(given: str | Domain | Mapping[str, Any]) -> Domain:
    """The domain that a name, settings with ``_target_`` or a domain itself stand for.

    Raises:
        NsmError: ``unknown_option`` for a name that no domain has, ``wrong_type`` for settings
            that make something else, and as :func:`nsm.instantiation.made`.
    """
    if isinstance(given, Mapping):
        from nsm.instantiation import made

        given = made(given)
    if isinstance(given, Domain):
        return given
    if isinstance(given, str) and given in DOMAINS:
        return DOMAINS[given]
    kind = "unknown_option" if isinstance(given, str) else "wrong_type"
    raise NsmError(
        f"domain {str(given)[:60]!r} is unknown; use one of {', '.join(DOMAINS)}",
        kind=kind,
        key="domain",
    )


def bounded(given: str | Domain | Mapping[str, Any]) -> BoundedDomain:
    """As :func:`domain`, for what needs a boundary.

    Raises:
        NsmError: also ``wrong_domain`` for a domain without boundary.
    """
    found = domain(given)
    if not isinstance(found, BoundedDomain):
        others = ", ".join(name for name, d in DOMAINS.items() if d.has_boundary)
        raise NsmError(
            f"domain {found} has no boundary; use one of {others}",
            kind="wrong_domain",
            key="domain",
        )
    return found


def from_stored(given: str | Mapping[str, Any], trust: Iterable[str] = ()) -> Domain:
    """As :func:`domain`, for what a file that may be a stranger's keeps of a domain.

    Raises:
        NsmError: also ``not_trusted`` (see :func:`nsm.instantiation.check_trusted`).
    """
    from nsm.instantiation import check_trusted

    check_trusted(given, trust)
    return domain(given)


def stored(found: Domain) -> str | dict[str, Any]:
    """What a file keeps of a domain for :func:`domain`: its name, or settings if it is not ours."""
    return found.name if DOMAINS.get(found.name) == found else found.config
