"""The latest results of work on meshes, so that the stages of a run do it once for each mesh."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


class Recent:
    """Results by the content that they were made of; the oldest are forgotten first.

    Args:
        most_bytes: of the arrays of all results; one that is larger by itself is not kept.
    """

    def __init__(self, most_bytes: int = 2**25) -> None:
        self.most_bytes = most_bytes
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """The result under a key, or the one that is made now; its arrays are the caller's own.

        Args:
            key: all that the result depends on.
            make: an array, or a tuple or data class of arrays and immutable values.
        """
        if key in self._kept:
            self._kept.move_to_end(key)
            kept: T = _copied(self._kept[key])
            return kept
        made = make()
        if _size(made) <= self.most_bytes:
            self._kept[key] = _copied(made)
            while sum(map(_size, self._kept.values())) > self.most_bytes:
                self._kept.popitem(last=False)
        return made


def content(*parts: np.ndarray | bytes) -> str:
    """Hash of arrays, their types and shapes, and of bytes."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str}{part.shape}".encode())
            part = np.ascontiguousarray(part).tobytes()
        digest.update(part)
    return digest.hexdigest()


def _copied(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, tuple):
        return tuple(map(_copied, value))
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: _copied(getattr(value, f.name)) for f in fields(value)})
    return value


def _size(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, tuple):
        return sum(map(_size, value))
    if is_dataclass(value) and not isinstance(value, type):
        return sum(_size(getattr(value, f.name)) for f in fields(value))
    return 0
