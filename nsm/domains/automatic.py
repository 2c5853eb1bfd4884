"""The domain that suits surfaces, by their topology."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from nsm.domains.base import Domain
from nsm.domains.names import DOMAINS

# by genus and number of boundary loops
_CLOSED = {(0, 0): "orbifold", (1, 0): "torus"}


@dataclass(frozen=True)
class Automatic:
    """Stands for a domain until the surfaces are known: closed surfaces of genus 0 or 1 need no
    seam on an orbifold or torus; others are cut to a disc."""

    def chosen(self, topologies: Collection[tuple[int, int]]) -> Domain:
        """The domain for surfaces of given genus and number of boundary loops."""
        kinds = set(topologies)
        name = _CLOSED.get(next(iter(kinds)), "disc") if len(kinds) == 1 else "disc"
        return DOMAINS[name]


def is_part_of_whole(topologies: Sequence[tuple[int, int]]) -> bool:
    """Whether of two surfaces, by genus and number of boundary loops, the first is open, the second
    is closed, and both are of genus 0."""
    if len(topologies) != 2:
        return False
    (genus, loops), whole = topologies
    return genus == 0 and loops > 0 and whole == (0, 0)
