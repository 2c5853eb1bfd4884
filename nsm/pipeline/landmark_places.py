"""Landmarks inside triangles: made vertices of the meshes of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console

from nsm.domains.joint_preparation import Mesh
from nsm.pipeline.resolve_inputs import Shape, landmark_lists
from nsm.surfaces.inserted_points import with_points
from nsm.surfaces.landmarks import check_places, listed


def with_places(
    landmarks: Any, shapes: Sequence[Shape], console: Console
) -> tuple[list[Shape], Any, list[np.ndarray | None]]:
    """Shapes that have landmarks given as places in triangles for vertices, the last ones.

    Neural surfaces stay as they are: their places are those of the nearest vertices.

    Args:
        landmarks: as :func:`nsm.pipeline.resolve_inputs.landmark_vertices` takes them.
        shapes: two or more.
        console: where to say which vertices they are.

    Returns:
        the shapes; the landmarks, with vertices for places; and the places (L, 4) of each shape
        that has some.

    Raises:
        NsmError: ``out_of_range`` or ``not_on_surface`` for a place that is not on its shape, or as
            :func:`nsm.pipeline.resolve_inputs.landmark_vertices`.
    """
    result, lists, every = list(shapes), [], []
    for k, item in enumerate(landmark_lists(landmarks, len(shapes), console)):
        shape, places = shapes[k], None
        name = shape.name if isinstance(shape, Mesh) else shape.surface.name
        given = listed(item, f"landmarks of {name}")
        if isinstance(given, np.ndarray) and given.shape[1] == 4 and isinstance(shape, Mesh):
            check_places(given, shape.faces, shape.name)
            vertices, faces, ids = with_points(shape.vertices, shape.faces, given)
            count = len(shape.vertices)
            result[k], places = replace(shape, vertices=vertices, faces=faces), given
            if len(vertices) > count:
                console.print(
                    f"{shape.name}: {len(vertices) - count} landmarks inside triangles become "
                    f"vertices, numbers {count} to {len(vertices) - 1}",
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
