"""Landmarks being placed by hand on several shapes: what an editor changes, undoes and saves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nsm.surfaces.landmark_files import to_json


@dataclass(frozen=True)
class Landmark:
    """One landmark: its name, and its vertex on each shape, None where it is not placed yet."""

    name: str
    vertices: tuple[int | None, ...]

    @property
    def complete(self) -> bool:
        return None not in self.vertices


class LandmarkList:
    """Landmarks of a number of shapes.

    Args:
        shapes: how many.
        lists: vertices (L,) of each shape, to begin with; -1 for one that is not placed yet.
        names: of these; numbers by default.
    """

    def __init__(
        self,
        shapes: int,
        lists: Sequence[Sequence[int] | np.ndarray] = (),
        names: Sequence[str] | None = None,
    ) -> None:
        self.shapes = shapes
        self.landmarks: list[Landmark] = []
        self._before: list[list[Landmark]] = []
        for k, row in enumerate(zip(*lists, strict=True)):
            name = self._new_name() if names is None else names[k]
            self.landmarks.append(Landmark(name, tuple(None if v < 0 else int(v) for v in row)))

    def place(self, shape: int, vertex: int) -> int:
        """Put a point on a shape: of the first landmark without one there, else of a new one.

        Returns:
            the landmark's number; where the vertex is one already, of that landmark.
        """
        for k, landmark in enumerate(self.landmarks):
            if landmark.vertices[shape] == vertex:
                return k
        open_ = [k for k, mark in enumerate(self.landmarks) if mark.vertices[shape] is None]
        self._remember()
        if not open_:
            self.landmarks.append(Landmark(self._new_name(), (None,) * self.shapes))
            open_ = [len(self.landmarks) - 1]
        self._set(open_[0], shape, vertex)
        return open_[0]

    def move(self, number: int, shape: int, vertex: int) -> bool:
        """Move a landmark's point on a shape; False if the vertex is another landmark's."""
        at = [k for k, mark in enumerate(self.landmarks) if mark.vertices[shape] == vertex]
        if at and at != [number]:
            return False
        self._remember()
        self._set(number, shape, vertex)
        return True

    def delete(self, number: int) -> None:
        """Remove a landmark from all shapes."""
        self._remember()
        del self.landmarks[number]

    def rename(self, number: int, name: str) -> bool:
        """Give a landmark another name; False if it is empty or another landmark's."""
        if not name or any(m.name == name for k, m in enumerate(self.landmarks) if k != number):
            return False
        self._remember()
        self.landmarks[number] = replace(self.landmarks[number], name=name)
        return True

    def undo(self) -> bool:
        """Take the last change back; False if there is none."""
        if not self._before:
            return False
        self.landmarks = self._before.pop()
        return True

    def complete(self) -> tuple[list[str], list[list[int]]]:
        """Names (L) and vertices, a list (L) for each shape, of the landmarks that all have."""
        done = [mark for mark in self.landmarks if mark.complete]
        lists = [[int(m.vertices[k] or 0) for m in done] for k in range(self.shapes)]
        return [mark.name for mark in done], lists

    def to_json(self) -> str:
        """The complete landmarks as a file that every task reads."""
        names, lists = self.complete()
        return to_json(lists, names)

    def _remember(self) -> None:
        self._before.append(list(self.landmarks))

    def _set(self, number: int, shape: int, vertex: int) -> None:
        vertices = list(self.landmarks[number].vertices)
        vertices[shape] = vertex
        self.landmarks[number] = replace(self.landmarks[number], vertices=tuple(vertices))

    def _new_name(self) -> str:
        taken, k = {mark.name for mark in self.landmarks}, 1
        while str(k) in taken:
            k += 1
        return str(k)
