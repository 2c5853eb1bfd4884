"""Domains Ω and surfaces over them: layout, seams, certificates.

Disc and square have a boundary; orbifold and torus are closed.
"""

from nsm.domains.automatic import Automatic
from nsm.domains.base import BoundedDomain, Domain, Keys
from nsm.domains.disc import Disc
from nsm.domains.layout import Layout
from nsm.domains.names import DOMAINS, bounded, domain, from_stored, stored
from nsm.domains.orbifold.domain import Orbifold, Torus
from nsm.domains.square import Square
from nsm.domains.surface import Surface

__all__ = [
    "DOMAINS",
    "Automatic",
    "BoundedDomain",
    "Disc",
    "Domain",
    "Keys",
    "Layout",
    "Orbifold",
    "Square",
    "Surface",
    "Torus",
    "bounded",
    "domain",
    "from_stored",
    "stored",
]
