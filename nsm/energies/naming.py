"""Looking a name up, with a hint when it is misspelt."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import TypeVar

T = TypeVar("T")


def look_up(table: Mapping[str, T], name: str, kind: str) -> T:
    """``table[name]``.

    Args:
        table: what is known.
        name: what is asked for.
        kind: what it is, for the message: ``energy``, ``domain``.

    Raises:
        ValueError: the name is not known; the message gives the nearest one, and all.
    """
    if name in table:
        return table[name]
    nearest = get_close_matches(str(name), table, n=1, cutoff=0.0)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    raise ValueError(f"{kind} {name!r} is not known: {hint}known are {', '.join(table)}")
