"""Landmarks inside triangles: made vertices of the meshes of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console

from nsm.domains.joint_preparation import Mesh
from nsm.pipeline.landmark_inputs import landmark_lists, name_of
from nsm.pipeline.resolve_inputs import Shape
from nsm.surfaces.inserted_points import with_points
from nsm.surfaces.landmarks import MISSING, check_places, present
from nsm.wording import number_of


def with_places(
    landmarks: Any, shapes: Sequence[Shape], console: Console, *, template: bool = False
) -> tuple[list[Shape], Any, list[np.ndarray | None]]:
    """Shapes that have landmarks given as places in triangles for vertices, the last ones.

    Neural surfaces stay as they are: their places are those of the nearest vertices.

    Args:
        landmarks, template: as :func:`nsm.pipeline.landmark_inputs.landmark_vertices` takes them.
        shapes: two or more.
        console: where to say which vertices they are.

    Returns:
        the shapes; the landmarks, with vertices for places; and the places (L, 4) of each shape
        that has some.

    Raises:
        NsmError: ``out_of_range`` or ``not_on_surface`` for a place that is not on its shape, or as
            :func:`nsm.pipeline.landmark_inputs.landmark_vertices`.
    """
    result, lists, every = list(shapes), [], []
    names = [name_of(shape) for shape in shapes]
    for k, given in enumerate(landmark_lists(landmarks, names, console, template=template)):
        shape, places = shapes[k], None
        if isinstance(given, np.ndarray) and given.shape[1] == 4 and isinstance(shape, Mesh):
            there = np.flatnonzero(present(given))
            check_places(given[there], shape.faces, shape.name, there)
            vertices, faces, found = with_points(shape.vertices, shape.faces, given[there])
            ids = np.full(len(given), MISSING)
            ids[there] = found
            count = len(shape.vertices)
            result[k], places = replace(shape, vertices=vertices, faces=faces), given
            if len(vertices) > count:
                console.print(
                    f"{shape.name}: landmarks inside triangles become "
                    f"{number_of(len(vertices) - count, 'vertex')}, "
                    f"numbers {count} to {len(vertices) - 1}",
                    highlight=False,
                    soft_wrap=True,
                )
            given = ids.tolist()
        lists.append(given)
        every.append(places)
    if len(lists) == 2:  # two lists of two would be read as pairs
        return result, {"source": lists[0], "target": lists[1]}, every
    return result, lists, every


def as_places(rows: np.ndarray, faces: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Landmarks (L,) of which the first are at places (G, 4), and others are vertices, as places
    (L, 4)."""
    more = np.zeros((len(rows) - len(places), 4))
    for row, vertex in zip(more, rows[len(places) :].tolist(), strict=True):
        face, corner = np.argwhere(faces == vertex)[0].tolist()
        row[0], row[1 + corner] = face, 1.0
    return np.concatenate([places, more])
