"""An open source and a closed target: a part of a shape is mapped into a whole one.

The part is closed for the map by caps that have the area that it lacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console

from nsm.correspondence.coarse_shape import edge_distances
from nsm.domains import Domain
from nsm.domains.automatic import is_part_of_whole
from nsm.domains.joint_preparation import Mesh
from nsm.pipeline.resolve_inputs import Shape
from nsm.surfaces.topology import face_areas, genus_and_boundary
from nsm.surfaces.validation import Repairs

_NEAREST = 3  # landmarks to which distances are compared: long ways may lead around what is missing
_FEWEST = 3  # landmarks that tell the scale


def closed_parts(
    shapes: Sequence[Shape],
    landmarks: Sequence[np.ndarray],
    domain: Domain,
    repairs: Repairs,
    console: Console,
) -> list[Shape]:
    """A source that is to be closed for its map, if it is a part and the target is whole.

    The area that it is closed to is the target's, in the units of the source.

    Args:
        shapes: source and target.
        landmarks: vertices (L,) of each.
        domain: of the map.
        repairs: the decisions on meshes.
        console: where it is said.
    """
    part, whole = shapes
    if domain.has_boundary or not isinstance(part, Mesh):
        return list(shapes)
    mesh = part.cleaned(repairs)
    if isinstance(whole, Mesh):
        other = whole.cleaned(repairs)
        points, faces, theirs = other.vertices, other.faces, other.merged
    else:
        surface = whole.surface
        first, faces = surface.whole()
        points = whole.in_original_units(surface.vertices[first])
        theirs = np.searchsorted(surface.source_vertex[first], np.arange(len(surface.cut_vertex)))
    kinds = [genus_and_boundary(f) for f in (mesh.faces, faces)]
    if not is_part_of_whole(kinds):
        return list(shapes)
    there = np.logical_and(*(ids >= 0 for ids in landmarks))
    marks = np.stack([mesh.merged[landmarks[0][there]], theirs[landmarks[1][there]]])
    scale, why = 1.0, "that of the files, for lack of landmarks"
    if len(marks[0]) >= _FEWEST and (marks >= 0).all():
        scale = relative_scale((mesh.vertices, mesh.faces), (points, faces), marks)
        why = "by distances of landmarks"
    console.print(
        f"{part.name} is open, {whole_name(whole)} is closed: the map takes {part.name} into "
        f"{whole_name(whole)}; scale {scale:.4g}, {why}",
        highlight=False,
        soft_wrap=True,
    )
    area = scale**2 * float(face_areas(points, faces).sum())
    return [replace(part, closed_area=area), whole]


def relative_scale(
    part: tuple[np.ndarray, np.ndarray], whole: tuple[np.ndarray, np.ndarray], marks: np.ndarray
) -> float:
    """How long a unit of the whole is on the part: the median ratio of the distances, along edges,
    from landmarks to the nearest others.

    Args:
        part, whole: vertices (V, 3) and faces (F, 3).
        marks: (2, L) corresponding vertices, two or more.
    """
    ours, theirs = (
        edge_distances(*mesh, ids)[:, ids] for mesh, ids in zip((part, whole), marks, strict=True)
    )
    away = np.where(theirs > 0, theirs, np.inf)
    near = np.argsort(away, axis=1)[:, :_NEAREST]
    ratio = np.take_along_axis(ours, near, axis=1) / np.take_along_axis(away, near, axis=1)
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    return float(np.median(ratio)) if len(ratio) else 1.0


def whole_name(shape: Shape) -> str:
    """The name of a surface."""
    return shape.name if isinstance(shape, Mesh) else shape.surface.name
