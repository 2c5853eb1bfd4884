"""Planar domains Ω and surfaces over them: layout, seams, certificates. Disc and square."""

from nsm.domains.base import BoundedDomain, Domain, Keys
from nsm.domains.disc import Disc
from nsm.domains.names import DOMAINS, bounded, domain, from_stored, stored
from nsm.domains.square import Square
from nsm.domains.surface import Surface

__all__ = [
    "DOMAINS",
    "BoundedDomain",
    "Disc",
    "Domain",
    "Keys",
    "Square",
    "Surface",
    "bounded",
    "domain",
    "from_stored",
    "stored",
]
