"""An open source and a closed target: a part of a shape is mapped into a whole one.

The part is closed for the map by caps that have the area that it lacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.text import Text

from nsm.correspondence.distances import edge_distances
from nsm.domains import Domain
from nsm.domains.automatic import is_part_of_whole
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.maps import AnalyticSurface
from nsm.pipeline.resolve_inputs import Shape
from nsm.surfaces.topology import boundary_loops, face_areas, genus_and_boundary
from nsm.surfaces.validation import Repairs
from nsm.wording import number_of

_NEAREST = 3  # landmarks to which distances are compared: long ways may lead around what is missing
_FEWEST = 3  # landmarks that tell the scale
_CONES = 4


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

    Returns:
        source and target.

    Raises:
        NsmError: ``too_few_landmarks``: a part without any; ``wrong_topology``: a part and a target
            in closed form.
    """
    # the cones of both are chosen together: what was laid out alone is laid out again
    part, whole = (_mesh(shape) for shape in shapes)
    if domain.has_boundary or part is None:
        return list(shapes)
    mesh = part.cleaned(repairs)
    if whole is None:
        if boundary_loops(mesh.faces) and _is_analytic(shapes[1]):
            raise NsmError(
                f"{part.name} is open: a part is mapped into a closed mesh, not into a surface in "
                "closed form; give a mesh as the target",
                kind="wrong_topology",
                key="target",
            )
        return list(shapes)
    other = whole.cleaned(repairs)
    if not is_part_of_whole([genus_and_boundary(m.faces) for m in (mesh, other)]):
        return list(shapes)
    if not len(landmarks[0]):
        raise NsmError(
            f"{part.name} is open, {whole.name} is closed: without landmarks nothing says where "
            f"the part belongs; give {_CONES} landmarks or more that are on the part",
            kind="too_few_landmarks",
            key="landmarks",
        )
    points, faces = other.vertices, other.faces
    marks = np.stack([mesh.merged[landmarks[0]], other.merged[landmarks[1]]])
    scale, why = 1.0, "that of the files, for lack of landmarks"
    if marks.shape[1] >= _FEWEST and (marks >= 0).all():
        scale = relative_scale((mesh.vertices, mesh.faces), (points, faces), marks)
        why = "by distances between landmarks"
    console.print(
        f"{part.name} is open, {whole.name} is closed: {part.name} is mapped into {whole.name}; a "
        f"unit of the target is {scale:.4g} of the source, {why}",
        soft_wrap=True,
    )
    if marks.shape[1] < _CONES:
        console.print(
            Text(
                f"WARNING: {number_of(marks.shape[1], 'landmark')} cannot say where a part "
                f"belongs; give {_CONES} or more",
                style="yellow",
            ),
            soft_wrap=True,
        )
    area = scale**2 * float(face_areas(points, faces).sum())
    return [replace(part, closed_area=area), whole]


def _mesh(shape: Shape) -> Mesh | None:
    """The mesh of a shape; None for an analytic one, and for one whose mesh is not known."""
    if isinstance(shape, Mesh):
        return shape
    if _is_analytic(shape) or shape.surface.raw is None:
        return None
    return Mesh(shape.surface.name, *shape.surface.raw)


def _is_analytic(shape: Shape) -> bool:
    return not isinstance(shape, Mesh) and isinstance(shape.map, AnalyticSurface)


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
