"""Where a map may be trusted: a few figures for each vertex of the source's mesh file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize, TwoSlopeNorm
from scipy.sparse.csgraph import dijkstra

from nsm.domains import Surface
from nsm.domains.planar_mesh import signed_areas
from nsm.energies import symmetric_dirichlet
from nsm.results.file_faces import faces_of_file
from nsm.results.files import atomic_write
from nsm.results.map_metrics import triangle_metric
from nsm.results.pictures import PANEL, panels, save_figure
from nsm.results.render import Blend, View
from nsm.results.vertex_values import by_file_vertex
from nsm.surfaces.geometry import edge_graph
from nsm.surfaces.topology import face_areas

if TYPE_CHECKING:
    from nsm.results.surface_map import SurfaceMap

_BEST, _WORST = 4.0, 20.0  # the colour scale of symmetric Dirichlet


class Reliability(NamedTuple):
    """Figures (W,) at the vertices of the source's mesh file; NaN at those not on the surface.

    Attributes:
        distortion: symmetric Dirichlet of the map, the mean over the triangles around the vertex,
            weighted by area; 3.98 at best. It is scale-free: both surfaces have the area of Ω.
        stretch: the smallest factor by which a triangle around the vertex stretches a length, in
            units of the target's file per unit of the source's; negative where one is flipped.
        landmark_distance: to the nearest landmark along the edges of the source, in the units of
            its file; infinite without landmarks.
    """

    distortion: np.ndarray
    stretch: np.ndarray
    landmark_distance: np.ndarray


def reliability(f: SurfaceMap) -> Reliability:
    """The figures of a map at the vertices of its source's file (see :class:`Reliability`)."""
    s, t = f.source.surface, f.target.surface
    around = s.source_vertex[s.faces]  # negative at inserted points
    known = (around >= 0) & ~s.filled[:, None]
    rows = around[known]
    areas = face_areas(s.vertices, s.faces)
    energy, stretch = _of_triangles(s, f.image, f.image_uv)
    count = len(s.cut_vertex)
    total, weight = np.zeros(count), np.zeros(count)
    share = np.repeat(areas, known.sum(axis=1))
    np.add.at(total, rows, np.repeat(energy, known.sum(axis=1)) * share)
    np.add.at(weight, rows, share)
    least = np.full(count, np.inf)
    np.minimum.at(least, rows, np.repeat(stretch, known.sum(axis=1)) * (s.scale / t.scale))
    with np.errstate(invalid="ignore", divide="ignore"):
        figures = (total / weight, least, _landmark_distance(f))
    here = by_file_vertex(s, s.source_vertex)
    absent = s.cut_vertex < 0
    return Reliability(*(np.where(absent, np.nan, values[here]) for values in figures))


def _of_triangles(
    source: Surface, image: np.ndarray, image_uv: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Symmetric Dirichlet (F,), and the smaller singular value (F,), negative if flipped."""
    a, b = triangle_metric(source.vertices, source.faces), triangle_metric(image, source.faces)
    energy = np.nan_to_num(symmetric_dirichlet(a, b).numpy(), nan=np.inf)
    mapped = np.linalg.solve(a.numpy(), b.numpy())  # similar to JᵀJ
    trace = mapped[:, 0, 0] + mapped[:, 1, 1]
    determinant = np.linalg.det(b.numpy()).clip(min=0) / np.linalg.det(a.numpy())
    larger = 0.5 * (trace + np.sqrt((trace**2 - 4 * determinant).clip(min=0)))
    # det / σ₁² keeps the digits of a small σ₂² that trace/2 - root would lose
    smaller = np.sqrt(determinant / np.maximum(larger, 1e-300))
    return energy, np.where(signed_areas(image_uv, source.faces) > 0, smaller, -smaller)


def _landmark_distance(f: SurfaceMap) -> np.ndarray:
    """Lengths (W,) of shortest paths along edges to the nearest landmark."""
    s = f.source.surface
    count = len(s.cut_vertex)
    if not len(f.landmarks):
        return np.full(count, np.inf)
    points = by_file_vertex(s, f.source.in_original_units(s.vertices))
    graph = edge_graph(points, s.file_faces()[0])
    marks = np.unique(s.kept(f.landmarks[:, 0].tolist()))
    return np.asarray(dijkstra(graph, directed=False, indices=marks, min_only=True))


def write_reliability(path: str | Path, f: SurfaceMap) -> None:
    """Write the source's mesh as PLY, with the three figures and colours at its vertices.

    Raises:
        OSError: the folder cannot be written.
    """
    figures = f.reliability
    colours = _colours(figures)[0]
    names = ("x", "y", "z", *Reliability._fields)
    kinds = [(name, "<f8") for name in names]
    kinds += [(name, "u1") for name in ("red", "green", "blue")]
    vertices = f.source.file_mesh()[0]
    table = np.empty(len(vertices), dtype=kinds)
    columns = (*vertices.T, *figures, *np.rint(255 * colours).astype(np.uint8).T)
    for (name, _), column in zip(kinds, columns, strict=True):
        table[name] = column
    faces = faces_of_file(f.source.surface)[0]
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    words = {"<f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {words[kind]} {name}" for name, kind in kinds]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    data = "\n".join(header).encode() + b"\n" + table.tobytes() + rows.tobytes()
    atomic_write(path, data)


def reliability_picture(path: str | Path, f: SurfaceMap) -> None:
    """The source three times, coloured by each of the figures."""
    s = f.part.source.surface
    colours = _colours(f.reliability)
    # a point inserted between vertices takes the colour of one of them
    row = np.maximum(s.source_vertex, 0)
    shape = View(s.vertices, PANEL).seen(s.vertices, s.faces, s.seam_pairs)
    titles = (
        f"symmetric Dirichlet, {_BEST:.0f} (dark) to {_WORST:.0f} (bright)",
        "smallest stretch, red where flipped",
        "distance to the nearest landmark",
    )
    drawn = []
    for of_vertices, title in zip(colours, titles, strict=True):
        paint = _painted(of_vertices[row])
        drawn.append((shape.painted(paint), title))
    save_figure(panels(drawn), path)


def _painted(colours: np.ndarray) -> Callable[[Blend], np.ndarray]:
    return lambda blend: blend(colours)


def _colours(figures: Reliability) -> list[np.ndarray]:
    """Colours (W, 3) in [0, 1] by each figure, grey where there is none."""
    middle = float(np.nanmedian(figures.stretch))
    spread = max(abs(middle), 1e-12)
    away = figures.landmark_distance
    farthest = float(away[np.isfinite(away)].max(initial=0.0)) or 1.0
    scales = (
        (figures.distortion.clip(_BEST, _WORST), LogNorm(_BEST, _WORST), "viridis"),
        (figures.stretch, TwoSlopeNorm(0.0, -spread, spread), "RdBu"),
        (away, Normalize(0, farthest), "viridis"),
    )
    result = []
    for values, norm, name in scales:
        colours = ScalarMappable(norm, name).to_rgba(np.nan_to_num(values, posinf=0.0))[:, :3]
        result.append(np.where(np.isfinite(values)[:, None], colours, 0.8))
    return result
