"""Pictures of maps between surfaces."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from PIL import Image

from nsm.domains import Surface
from nsm.energies import symmetric_dirichlet
from nsm.energies.distortion import LEAST_SYMMETRIC_DIRICHLET
from nsm.results.files import atomic_write, write_png
from nsm.results.map_metrics import triangle_metric
from nsm.results.meshes import by_position
from nsm.results.pictures import PANEL, by_normals, checked, panels, save_figure, vertex_means
from nsm.results.render import Blend, View, vertex_normals
from nsm.results.spheres import Spheres
from nsm.results.surface_map import SurfaceMap
from nsm.results.textures import GREY

_MORPH = 300  # pixels, the side of a picture of the morph
_LEAST, WORST = LEAST_SYMMETRIC_DIRICHLET, 20.0  # ends of the colour scale
_TICKS = [_LEAST, 5, 7, 10, 20]
_SCALE = ScalarMappable(LogNorm(_LEAST, WORST), "viridis")


def transfer_picture(path: str | Path, f: SurfaceMap) -> None:
    """The source's checkerboard and colours of position, beside both transferred to the target.

    The target is drawn with its own triangles, aligned with the source. Landmarks are spheres, of
    one colour for the two of a pair.
    """
    s, t = f.part.source.surface, f.target.surface
    target = f.aligned(t.vertices)
    colours = by_position(s.vertices)
    carried = _on_target(f, colours)
    board = np.where(f.unreached[:, None], np.nan, f.source_uv)
    left, right = View(s.vertices, PANEL), View(target, PANEL, frame=View(s.vertices, 8).frame)

    def drawn(
        view: View, vertices: np.ndarray, surface: Surface, column: int
    ) -> Callable[[Callable[[Blend], np.ndarray]], np.ndarray]:
        at = surface.cut_vertex[f.landmarks[:, column]]
        spheres = Spheres(vertices, surface.faces, at)
        shape = view.seen(*spheres.mesh, surface.seam_pairs)
        return lambda paint: shape.painted(spheres.painted(paint))

    at_source, at_target = drawn(left, s.vertices, s, 0), drawn(right, target, t, 1)

    rows = [
        [
            (at_source(checked(s.uv)), f"{s.name}: checkerboard"),
            (at_target(checked(board)), f"transferred to {t.name}"),
        ],
        [
            (at_source(lambda blend: blend(colours)), "colours of position"),
            (at_target(lambda blend: blend(carried)), f"transferred to {t.name}"),
        ],
    ]
    save_figure(panels(*rows), path)


def normals_picture(path: str | Path, f: SurfaceMap) -> None:
    """The source coloured by its normals, and these colours transferred to the target, such as an
    analytic surface: features that its shape does not have show where the source's come to lie."""
    s, t = f.part.source.surface, f.target.surface
    normals = vertex_normals(s.vertices, s.faces, s.seam_pairs)
    left, right = View(s.vertices, PANEL), View(t.vertices, PANEL)
    carried = _on_target(f, normals)
    panel = [
        (left.draw(s.vertices, s.faces, by_normals(normals), s.seam_pairs), f"{s.name}: normals"),
        (
            right.draw(t.vertices, t.faces, by_normals(carried), t.seam_pairs),
            f"transferred to {t.name}",
        ),
    ]
    save_figure(panels(panel), path)


def _on_target(f: SurfaceMap, values: np.ndarray) -> np.ndarray:
    """Values (V, ...) at the vertices of the source without caps, at the target's vertices; grey
    where there is none."""
    s = f.source.surface
    every = np.empty((len(s.vertices), *values.shape[1:]))
    every[:] = GREY
    every[s.of_part] = values
    carried = f._back.take(every, s.faces)
    carried[f.unreached] = GREY
    return carried


def distortion_picture(path: str | Path, f: SurfaceMap) -> None:
    """Symmetric Dirichlet on the source and on its image, with its histogram."""
    f = f.part
    s = f.source.surface
    value = _energy(s, f.image)
    scale, colours = _SCALE, _coloured(s, value)
    view = View(s.vertices, PANEL)
    image = f.aligned_image
    other = View(image, PANEL, frame=view.frame)
    figure = panels(
        [
            (
                view.draw(s.vertices, s.faces, lambda blend: blend(colours), s.seam_pairs),
                f"{s.name}: symmetric Dirichlet",
            ),
            (
                other.draw(image, s.faces, lambda blend: blend(colours), s.seam_pairs),
                f"its image on {f.target.surface.name}",
            ),
            (np.ones((PANEL, PANEL, 3)), ""),
        ],
        bar=True,
    )
    axes = figure.axes[2]
    axes.clear()
    axes.set_aspect("auto")
    axes.set_position((0.64, 0.14, 0.24, 0.74))
    axes.hist(np.clip(value, _LEAST, WORST), bins=np.geomspace(_LEAST, WORST, 60), color="#345c8c")
    axes.set_xscale("log")
    axes.set_xticks(_TICKS, [*map(str, _TICKS[:-1]), f"≥ {_TICKS[-1]}"])
    axes.set_xticks([], minor=True)
    axes.set_title(f"triangles; median {np.median(value):.2f}")
    bar = figure.colorbar(scale, cax=figure.add_axes((0.91, 0.2, 0.012, 0.6)), extend="max")
    bar.set_ticks(_TICKS, labels=map(str, _TICKS))
    bar.ax.set_yticks([], minor=True)
    save_figure(figure, path)


def distorted(view: View, surface: Surface, image: np.ndarray) -> np.ndarray:
    """A surface coloured by the symmetric Dirichlet energy of its map to ``image`` (V, 3)."""
    colours = _coloured(surface, _energy(surface, image))
    vertices, faces = surface.vertices, surface.faces
    return view.draw(vertices, faces, lambda blend: blend(colours), surface.seam_pairs)


def _energy(surface: Surface, image: np.ndarray) -> np.ndarray:
    """Symmetric Dirichlet (F,) of the map of a surface's triangles to ``image`` (V, 3)."""
    before, after = (triangle_metric(v, surface.faces) for v in (surface.vertices, image))
    return np.asarray(symmetric_dirichlet(before, after).numpy())


def _coloured(surface: Surface, value: np.ndarray) -> np.ndarray:
    """Colours (V, 3) of values (F,) of its triangles."""
    at_vertex = vertex_means(np.minimum(value, 1e3), surface.faces, len(surface.vertices))
    return np.asarray(_SCALE.to_rgba(at_vertex)[:, :3])


def morph_pictures(strip: str | Path, animation: str | Path, f: SurfaceMap) -> None:
    """The morph from source to target: five pictures in a row, and a GIF, back and forth."""
    f = f.part
    s = f.source.surface
    start, end = s.vertices, f.aligned_image
    both = np.concatenate([start, end])
    view = View(both, _MORPH, frame=View(s.vertices, 8).frame)

    def draw(t: float) -> np.ndarray:
        points = (1 - t) * start + t * end
        picture = view.draw(points, s.faces, checked(s.uv), s.seam_pairs)
        return np.round(255 * picture).astype(np.uint8)

    drawn = [draw(t) for t in np.linspace(0, 1, 9)]
    write_png(strip, Image.fromarray(np.concatenate(drawn[::2], axis=1)))
    # with their palettes, which each frame otherwise gets whenever it is shown
    frames = [Image.fromarray(d).convert("P", palette=Image.Palette.ADAPTIVE) for d in drawn]
    frames += frames[-2:0:-1]
    data = io.BytesIO()
    frames[0].save(
        data, format="GIF", save_all=True, append_images=frames[1:], duration=120, loop=0
    )
    atomic_write(animation, data.getvalue())


def map_image(
    source: Surface, target: Surface, image_uv: np.ndarray, uv: np.ndarray | None = None
) -> np.ndarray:
    """A quick picture (384, 384, 3) uint8: the source's checkerboard on its image.

    Args:
        source, target: the surfaces.
        image_uv: (V, 2), where points go in the domain of the target.
        uv: (V, 2), these points in the domain of the source, with its faces; its vertices by
            default.
    """
    image = target.at(image_uv)
    view = View(target.vertices, 384)
    drawn = view.draw(image, source.faces, checked(source.uv if uv is None else uv))
    return np.round(255 * drawn).astype(np.uint8)
