"""Texture atlases: charts of a mesh side by side in the unit square."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from nsm.side_by_side import apart
from nsm.stages import at
from nsm.surfaces.loading import error_in

PADDING = 6  # texels between charts, at the size for which an atlas is packed
# A chart has at most this share of the area. Smaller charts have more seams; the time of xatlas
# grows faster than the number of a chart's faces, so those of large meshes are smaller.
_LARGEST_CHART = 0.05
_CHART_FACES = 2000
_QUICK = 4000  # faces, of which xatlas holds the interpreter for less than a second


def unwrapped(
    vertices: np.ndarray, faces: np.ndarray, *, size: int = 1024, name: str = "mesh"
) -> np.ndarray:
    """An atlas of a mesh whose charts are little distorted and do not overlap (xatlas).

    Args:
        vertices: (V, 3), in any unit.
        faces: (F, 3).
        size: of the texture in texels, in which charts are kept :data:`PADDING` apart.
        name: of the mesh, in errors.

    Returns:
        (F, 3, 2) texture coordinates in [0, 1] at the corners of the faces. Some charts may be
        mirrored.

    Raises:
        NsmError: ``not_unwrapped``: no face has an area.
    """
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * float(np.linalg.norm(normal, axis=1).sum())
    if not area > 0:
        raise error_in(
            name, "not_unwrapped", "it has no area; give a mesh with texture coordinates"
        )
    centred = (vertices - vertices.mean(axis=0)) / np.sqrt(area)
    work = partial(_generated, centred, faces, size)
    at("texture atlas")
    return apart(work) if len(faces) > _QUICK else work()


def _generated(centred: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """The atlas (F, 3, 2) of a mesh of area one."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(centred.astype(np.float32), faces.astype(np.uint32))
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_chart_area = float(np.clip(_CHART_FACES / len(faces), 0.0, _LARGEST_CHART))
    packing.padding, packing.resolution, packing.bilinear = PADDING, size, True
    packing.rotate_charts = packing.rotate_charts_to_axis = False
    atlas.generate(charts, packing)
    _, index, uv = atlas[0]
    # the width and height differ a little; one scale for both keeps angles
    scale = np.array([atlas.width, atlas.height]) / max(atlas.width, atlas.height)
    return (uv.astype(np.float64) * scale)[index.astype(np.int64).reshape(-1, 3)]


def packed(
    charts: Sequence[tuple[np.ndarray, np.ndarray]], *, size: int = 1024
) -> tuple[list[np.ndarray], float]:
    """Flat charts side by side in the unit square, moved and all in one scale (xatlas).

    Args:
        charts: points (V, 2) and counter-clockwise faces (F, 3) of each, without overlaps.
        size: of the texture in texels, in which charts are kept :data:`PADDING` apart.

    Returns:
        The points (V, 2) of each, and the scale: length in the square over that in the charts.
    """
    import xatlas

    first = np.cumsum([0, *(len(uv) for uv, _ in charts)])
    points = np.concatenate([uv for uv, _ in charts])
    faces = np.concatenate([f + n for (_, f), n in zip(charts, first, strict=False)])
    extent = float(np.ptp(points, axis=0).max())
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh((points / extent).astype(np.float32), faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.padding, packing.resolution, packing.bilinear = PADDING, size, True
    # xatlas turns charts by mirroring them
    packing.rotate_charts = packing.rotate_charts_to_axis = False
    atlas.generate(pack_options=packing)
    _, index, uv = atlas[0]
    side = np.array([atlas.width, atlas.height]) / max(atlas.width, atlas.height)
    corners = (uv.astype(np.float64) * side)[index.astype(np.int64).reshape(-1)]
    # single precision places charts; each is then moved as a whole
    flat = faces.reshape(-1)
    found = []
    for k, (own, _) in enumerate(charts):
        mine = (flat >= first[k]) & (flat < first[k + 1])
        found.append((own[flat[mine] - first[k]], corners[mine]))
    scale = float(np.mean([_spread(there) / _spread(here) for here, there in found]))
    placed = [
        scale * (own - here.mean(axis=0)) + there.mean(axis=0)
        for (own, _), (here, there) in zip(charts, found, strict=True)
    ]
    low = np.min([own.min(axis=0) for own in placed], axis=0)
    extent = float((np.max([own.max(axis=0) for own in placed], axis=0) - low).max())
    return [(own - low) / extent for own in placed], scale / extent


def _spread(points: np.ndarray) -> float:
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum()))
