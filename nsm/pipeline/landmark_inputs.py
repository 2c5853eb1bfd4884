"""From settings that name landmarks to vertices of the surfaces' mesh files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline.resolve_inputs import Shape
from nsm.surfaces.catalogue import catalogue_landmarks, has_landmarks
from nsm.surfaces.landmark_files import (
    Marks,
    read_collection,
    read_marks,
    read_names,
    read_pairs,
)
from nsm.surfaces.landmark_lookup import files_in, read_table
from nsm.surfaces.landmarks import (
    MISSING,
    AtVertices,
    Landmarks,
    as_lists,
    as_vertices,
    check_equal_lengths,
    listed,
    present,
)
from nsm.wording import number_of

_MOVED = 1e-4  # percent of the diagonal: less is the rounding of a file's digits


def landmark_vertices(
    given: Any,
    shapes: Sequence[Shape],
    console: Console | None = None,
    *,
    template: bool = False,
    told: bool = False,
) -> list[np.ndarray]:
    """Landmarks as vertices (L,) of each shape's mesh file.

    A landmark that a shape lacks is -1 there. Each has two shapes at least; others are left out,
    and so are, of two shapes, all that one of them lacks.

    Args:
        given: None; a JSON file; a CSV file (see :func:`nsm.surfaces.landmark_lookup.read_table`);
            a folder with a file for each shape, which has its name; one file or catalogue name, or
            one list of vertices, points or places, per shape; or, for two shapes, a list of pairs.
            Where all files have names, landmarks of one name correspond.
        shapes: two or more.
        console: where to say how far landmarks are moved, and which are left out.
        template: whether the first shape's landmarks are the list, so that names it lacks are left
            out.
        told: whether it is said already which are left out.

    Raises:
        NsmError: a file that cannot be read, a landmark that is not on its shape, or given twice,
            lists of different lengths, or a shape that has no landmark in common with another.
    """
    silent = Console(quiet=True)
    console = console or silent
    names = [name_of(shape) for shape in shapes]
    lists = landmark_lists(given, names, silent if told else console, template=template)
    result = []
    for list_, shape, name in zip(lists, shapes, names, strict=True):
        found, diagonal = _vertices(list_, shape)
        result.append(found.vertex)
        percent = 100 * found.moved / diagonal
        if percent.max(initial=0.0) > _MOVED:
            largest = f"{percent.max():.3f} % at most"
            console.print(
                f"landmarks of {name}: maps take vertices; moved to the nearest ones by "
                f"{percent.mean():.3f} % of the diagonal in the mean, {largest}",
                highlight=False,
                soft_wrap=True,
            )
    return result


def landmark_lists(
    given: Any, names: Sequence[str], console: Console, *, template: bool = False
) -> list[Landmarks]:
    """Landmarks as :func:`landmark_vertices` takes them, for each of the surfaces with these names.

    Each has two surfaces at least; others are left out and told.

    Raises:
        NsmError: as :func:`landmark_vertices`.
    """
    lists, labels = all_landmarks(given, names)
    there = np.stack([present(own) for own in lists])
    shared = there.sum(axis=0) > 1
    if template:
        shared &= there[0]
    for own, name in zip(there & shared, names, strict=True):
        if there.any() and not own.any():
            raise NsmError(
                f"landmarks: {name} has none in common with the others; give corresponding "
                "landmarks one name, or one place in the lists",
                kind="different_names",
                key="landmarks",
            )

    def said(which: np.ndarray) -> str:
        numbers = np.flatnonzero(which).tolist()
        return ", ".join(str(k) if labels is None else labels[k] for k in numbers)

    lines = []
    if not shared.all():
        why = f"{names[0]} lacks them" if template else "one surface alone has them"
        lines.append(f"landmarks left out, as {why}: {said(~shared)}")
    for own, name in zip(there, names, strict=True):
        if (shared & ~own).any():
            lines.append(f"landmarks that {name} lacks: {said(shared & ~own)}")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    kept = np.flatnonzero(shared).tolist()
    return [own[kept] if isinstance(own, np.ndarray) else [own[k] for k in kept] for own in lists]


def all_landmarks(given: Any, surfaces: Sequence[str]) -> tuple[list[Landmarks], list[str] | None]:
    """Landmarks as :func:`landmark_vertices` takes them, also those that one surface alone has, for
    each of the surfaces with these names; and the landmarks' names, if they have some.

    Raises:
        NsmError: a file that cannot be read, or lists of different lengths.
    """
    found, labels = _lists(given, surfaces)
    lists = [listed(x, f"landmarks of {name}") for x, name in zip(found, surfaces, strict=True)]
    check_equal_lengths(surfaces, lists)
    if labels is not None and len(labels) != len(lists[0]):
        raise NsmError(
            f"{given}: {number_of(len(labels), 'name')} for "
            f"{number_of(len(lists[0]), 'landmark')}; give one for each",
            kind="different_lengths",
            key="landmarks",
        )
    return lists, labels


def _lists(given: Any, surfaces: Sequence[str]) -> tuple[list[Any], list[str] | None]:
    """A list of landmarks for each surface, and the landmarks' names, if they have some."""
    count, labels = len(surfaces), None
    if given is None:
        return [[] for _ in range(count)], None
    lists: list[Any]
    if isinstance(given, (str, Path)) and Path(given).is_dir():
        lists, labels = _corresponding(files_in(given, surfaces))
    elif isinstance(given, (str, Path)) and Path(given).suffix.lower() == ".csv":
        table = read_table(given)
        for name in surfaces:
            if name not in table.columns:
                raise NsmError(
                    f"{given}: no column {name}; it has {', '.join(table.columns)}",
                    kind="different_names",
                    key=str(given),
                )
        lists, labels = [table.columns[name] for name in surfaces], table.names
    elif isinstance(given, (str, Path)):
        lists = list(read_pairs(given)) if count == 2 else read_collection(given)
        labels = read_names(given)
    elif isinstance(given, dict):
        try:
            lists = [given["source"], given["target"]]
        except KeyError as error:
            raise NsmError(
                f"landmarks: {error} is missing beside the other list",
                kind="missing_setting",
                key="landmarks",
            ) from None
    else:
        lists = as_lists(given)
        if not isinstance(lists, list):
            raise NsmError(
                "landmarks: neither lists of landmarks nor files",
                kind="wrong_type",
                key="landmarks",
            )
        if lists and all(isinstance(item, (str, Path)) for item in lists):
            lists, labels = _corresponding(lists)
        elif count == 2 and lists and all(_is_pair(item) for item in lists):
            lists = [[pair[0] for pair in lists], [pair[1] for pair in lists]]
        else:
            lists = [_marks(x).landmarks if isinstance(x, (str, Path)) else x for x in lists]
    if not lists:
        return [[] for _ in range(count)], None
    if len(lists) != count:
        raise NsmError(
            f"landmarks: {number_of(len(lists), 'list')} for {count} surfaces; give one for each",
            kind="out_of_range",
            key="landmarks",
        )
    return lists, labels


def _marks(name: str | Path) -> Marks:
    """The landmarks in a file, or those of a mesh of the catalogue."""
    return catalogue_landmarks(str(name)) if has_landmarks(str(name)) else read_marks(name)


def _corresponding(files: Sequence[str | Path]) -> tuple[list[Any], list[str] | None]:
    """Landmarks of files in one order, and their names: by these if all files have names, else as
    they are."""
    marks = [_marks(file) for file in files]
    names = [mark.names for mark in marks if mark.names is not None]
    if len(names) < len(marks):
        return [mark.landmarks for mark in marks], None
    every = list(dict.fromkeys(name for of_one in names for name in of_one))
    lists = []
    for mark, of_one in zip(marks, names, strict=True):
        own = dict(zip(of_one, as_lists(mark.landmarks), strict=True))
        lists.append([own.get(name) for name in every])
    return lists, every


def _is_pair(item: Any) -> bool:
    """Whether an entry is a pair of landmarks, not a whole list of one surface's.

    Two lists of two vertices each look the same; they are read as pairs, which the documentation
    shows.
    """
    return isinstance(item, list) and len(item) == 2


def name_of(shape: Shape) -> str:
    """The name of a surface."""
    return shape.name if isinstance(shape, Mesh) else shape.surface.name


def _vertices(given: Landmarks, shape: Shape) -> tuple[AtVertices, float]:
    """Landmarks at vertices of the shape's file, and the diagonal in the unit of their moves."""
    if isinstance(shape, Mesh):
        diagonal = float(np.linalg.norm(np.ptp(shape.vertices, axis=0)))
        return as_vertices(given, shape.vertices, shape.faces, shape.name), diagonal
    surface = shape.surface
    diagonal = surface.bounding_box_diagonal / surface.scale
    if isinstance(given, list):
        ids = np.array(given, dtype=np.int64)
        some = ids[ids != MISSING]
        surface.preimages(some.tolist())  # raises for one that is not there
        as_vertices(surface.cut_vertex[some], surface.vertices, None, surface.name)
        return AtVertices(ids, np.zeros(len(ids))), diagonal
    known = np.flatnonzero(surface.source_vertex >= 0)
    points = shape.in_original_units(surface.vertices[known])
    found = as_vertices(given, points, None, surface.name)
    moved_to = surface.source_vertex[known[found.vertex]]
    return found._replace(vertex=np.where(found.vertex < 0, MISSING, moved_to)), diagonal
