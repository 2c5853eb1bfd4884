"""Pictures of surfaces: error beside the source, checkerboards, and quick looks for monitoring."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import nn

from nsm.domains import Surface
from nsm.energies import conformal, symmetric_dirichlet
from nsm.results.evaluation import evaluate, evaluate_jacobian
from nsm.results.files import PNG_LEVEL, atomic_write
from nsm.results.map_metrics import triangle_metric
from nsm.results.metrics import vertex_error
from nsm.results.render import Blend, View, vertex_normals
from nsm.results.textures import GREY, checkerboard_at
from nsm.surfaces.geometry import subdivide

if TYPE_CHECKING:
    from nsm.results.artifact import NeuralSurface

PANEL = 640
# at least as many triangles show the shape of φ rather than that of the mesh
_FINE_FACES = 30_000
_VANISHING = 1e-3  # of the mean area element around a vertex: less has no direction


def error_picture(path: str | Path, surface: Surface, neural: NeuralSurface) -> None:
    """Source beside reconstruction, coloured by distance in percent of the diagonal; below, both
    coloured by their normals."""
    error = vertex_error(surface, neural.map)
    scale = ScalarMappable(Normalize(0, max(float(np.percentile(error, 99)), 1e-6)), "viridis")
    view = View(surface.vertices, PANEL)
    shapes = [
        view.seen(x, surface.faces, surface.seam_pairs)
        for x in (surface.vertices, evaluate(neural.map, surface.uv))
    ]
    source = shapes[0].painted(_grey)
    colours = scale.to_rgba(error)[:, :3]
    image = shapes[1].painted(lambda blend: blend(colours))
    rms = neural.metrics.get("rms_percent")
    title = "neural surface" + (f", RMS {rms:.3f} % of the diagonal" if rms is not None else "")
    off = neural.metrics.get("normal_error_mean_degrees")
    normals = [
        vertex_normals(surface.vertices, surface.faces, surface.seam_pairs),
        normals_at_vertices(neural.map, surface),
    ]
    below = [
        (
            shape.painted(by_normals(normal)),
            "normals" + (f", mean error {off:.2f}°" if k and off is not None else ""),
        )
        for k, (shape, normal) in enumerate(zip(shapes, normals, strict=True))
    ]
    figure = panels([(source, f"{surface.name}: mesh"), (image, title)], below, bar=True)
    figure.colorbar(
        scale,
        cax=figure.add_axes((0.91, 0.55, 0.012, 0.35)),
        label="distance, % of the diagonal",
        extend="max",
    )
    save_figure(figure, path)


def neural_normals(phi: nn.Module, uv: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of φ at points (N, 2) of Ω; zero where its Jacobian is degenerate."""
    return _unit(_tangents_crossed(evaluate_jacobian(phi, uv)[1]))


def normals_at_vertices(phi: nn.Module, surface: Surface) -> np.ndarray:
    """Unit normals (V, 3) of φ; those of its image's triangles where its Jacobian vanishes, as at
    the cones of a closed domain."""
    points, jacobian = evaluate_jacobian(phi, surface.uv)
    normals = _tangents_crossed(jacobian)
    area = np.linalg.norm(normals, axis=1)
    middle = evaluate_jacobian(phi, surface.uv[surface.faces].mean(axis=1))[1]
    around = np.linalg.norm(_tangents_crossed(middle), axis=1)
    vanishing = area < _VANISHING * vertex_means(around, surface.faces, len(area))
    of_triangles = vertex_normals(points, surface.faces, surface.seam_pairs)
    return np.where(vanishing[:, None], of_triangles, _unit(normals))


def _tangents_crossed(jacobian: np.ndarray) -> np.ndarray:
    """φ_u × φ_v (N, 3) of Jacobians (N, 3, 2)."""
    return np.cross(jacobian[:, :, 0], jacobian[:, :, 1])


def _unit(vectors: np.ndarray) -> np.ndarray:
    unit: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-30)[:, None]
    return unit


def by_normals(normals: np.ndarray) -> Callable[[Blend], np.ndarray]:
    """Colours for :meth:`View.draw`: unit normals (V, 3) as red, green and blue."""
    return lambda blend: (0.5 * (1 + blend(normals))).clip(0, 1)


def checkerboard_picture(path: str | Path, surface: Surface, neural: NeuralSurface) -> None:
    """The neural surface with Ω's checkerboard on it, beside Ω."""
    uv, faces = fine(surface)
    image = View(surface.vertices, PANEL).draw(
        evaluate(neural.map, uv), faces, lambda blend: checkerboard_at(blend(uv))
    )
    side = 1.06 * (2 * (np.arange(PANEL) + 0.5) / PANEL - 1)
    grid = np.stack(np.meshgrid(side, side[::-1]), axis=-1)
    inside = surface.domain.contains(grid)
    flat = checkerboard_at(grid.reshape(-1, 2)).reshape(PANEL, PANEL, 3)
    flat = np.where(inside[:, :, None], flat, 1.0)
    titles = f"{surface.name}: neural surface", f"domain Ω: {surface.domain}"
    save_figure(panels([(image, titles[0]), (flat, titles[1])]), path)


def reconstruction_image(surface: Surface, phi: nn.Module, *, size: int = 384) -> np.ndarray:
    """A quick picture (size, size, 3) uint8 of φ."""
    uv, faces = fine(surface)
    picture = View(surface.vertices, size).draw(evaluate(phi, uv), faces, _grey)
    return np.round(255 * picture).astype(np.uint8)


def _grey(blend: Blend) -> np.ndarray:
    return GREY


def fine(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Points of Ω (N, 2) and faces (M, 3): the mesh, subdivided until it shows the shape of φ."""
    uv, faces = surface.uv, surface.faces
    while len(faces) < _FINE_FACES:
        uv, faces = subdivide(uv, faces)
    return uv, faces


def parameterization_picture(
    path: str | Path, surface: Surface, maps: Mapping[str, np.ndarray]
) -> None:
    """For each named map (V, 2): its checkerboard on the mesh, above its layout in the plane.

    The squares have one size everywhere, so that their images show area and angle distortion. The
    titles have the medians of D_iso (symmetric Dirichlet) and D_conf over the triangles.
    """
    vertices, faces = surface.vertices, surface.faces
    shape = View(vertices, PANEL).seen(vertices, faces, surface.seam_pairs)
    above = [(shape.painted(checked(uv)), name) for name, uv in maps.items()]
    below = [(layout_image(surface, uv, size=PANEL), _medians(surface, uv)) for uv in maps.values()]
    save_figure(panels(above, below), path)


def _medians(surface: Surface, uv: np.ndarray) -> str:
    source, image = (triangle_metric(x, surface.faces) for x in (surface.vertices, uv))
    isometric, conformally = (
        float(energy(source, image).median()) for energy in (symmetric_dirichlet, conformal)
    )
    return f"D_iso {isometric:.2f}, D_conf {conformally:.4f}"


def layout_image(surface: Surface, uv: np.ndarray, *, size: int = 384) -> np.ndarray:
    """The layout of a map (V, 2) in the plane, (size, size, 3) in [0, 1]."""
    flat = np.column_stack([uv, np.zeros(len(uv))])
    return View(flat, size, frame=np.eye(3)).draw(flat, surface.faces, checked(uv))


def vertex_means(values: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """At each of ``count`` vertices the mean (V,) of the values (F,) of the faces around it."""
    total, number = np.zeros(count), np.zeros(count)
    np.add.at(total, faces.ravel(), np.repeat(values, 3))
    np.add.at(number, faces.ravel(), 1)
    return total / np.maximum(number, 1)


def checked(uv: np.ndarray) -> Callable[[Blend], np.ndarray]:
    """Colours for :meth:`View.draw`: the checkerboard at coordinates uv (V, 2)."""
    return lambda blend: checkerboard_at(blend(uv))


def panels(*rows: list[tuple[np.ndarray, str]], bar: bool = False) -> Any:
    """A figure of pictures with their titles, in rows of equal length.

    Args:
        rows: pictures and titles.
        bar: whether the right tenth of the figure is left free, for a colour bar.
    """
    columns = len(rows[0])
    lines = max(title.count("\n") + 1 for row in rows for _, title in row)
    side, above = 5.1, 0.2 + 0.2 * lines  # inches of a picture, and of the titles above a row
    height = len(rows) * (side + above) + 0.05
    width = (5.5 * columns + 0.6) if bar else 5.1 * columns + 0.2
    figure = Figure(figsize=(width, height), dpi=120)
    for k, (image, title) in enumerate(panel for row in rows for panel in row):
        axes = figure.add_subplot(len(rows), columns, k + 1)
        axes.imshow(image, interpolation="antialiased")
        axes.set_title(title, y=1.0)  # where it is by default, which takes long to find out
        axes.set_axis_off()
    edges = {
        "left": 0.01,
        "right": 0.9 if bar else 0.99,
        "top": 1 - above / height,
        "bottom": 0.05 / height,
    }
    figure.subplots_adjust(**edges, wspace=0.02, hspace=above / side)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG (see :func:`atomic_write`)."""
    data = io.BytesIO()
    FigureCanvasAgg(figure).print_png(data, pil_kwargs={"compress_level": PNG_LEVEL})
    atomic_write(path, data.getvalue())
