"""Numbers of things in messages."""

from __future__ import annotations

_ENDINGS = {"vertex": "vertices", "boundary": "boundaries", "mesh": "meshes"}


def number_of(count: int, noun: str) -> str:
    """A number and its noun: ``1 face``, ``2 faces``.

    Args:
        count: how many.
        noun: of one; words before it do not change.
    """
    if count == 1:
        return f"{count} {noun}"
    before, _, last = noun.rpartition(" ")
    return f"{count} {before}{' ' if before else ''}{_ENDINGS.get(last, f'{last}s')}"
