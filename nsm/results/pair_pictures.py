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
from nsm.results.files import atomic_write
from nsm.results.map_metrics import triangle_metric
from nsm.results.pictures import PANEL, checked, panels, save_figure, vertex_means
from nsm.results.render import Blend, View
from nsm.results.surface_map import SurfaceMap

_STRIP, _GIF = 300, 300
_LEAST, _WORST = LEAST_SYMMETRIC_DIRICHLET, 20.0  # ends of the colour scale
_TICKS = [_LEAST, 5, 7, 10, 20]


def transfer_picture(path: str | Path, f: SurfaceMap) -> None:
    """The source's checkerboard and colours of position, beside both transferred to the target.

    The target is drawn with its own triangles, aligned with the source.
    """
    s, t = f.source.surface, f.target.surface
    target = f.aligned(t.vertices)
    low, extent = s.vertices.min(axis=0), np.ptp(s.vertices, axis=0)
    colours = (s.vertices - low) / np.maximum(extent, 1e-12)
    carried = f._back.take(colours, s.faces)
    left, right = View(s.vertices, PANEL), View(target, PANEL, frame=View(s.vertices, 8).frame)

    def at_source(paint: Callable[[Blend], np.ndarray]) -> np.ndarray:
        return left.draw(s.vertices, s.faces, paint, s.seam_pairs)

    def at_target(paint: Callable[[Blend], np.ndarray]) -> np.ndarray:
        return right.draw(target, t.faces, paint, t.seam_pairs)

    rows = [
        [
            (at_source(checked(s.uv)), f"{s.name}: checkerboard"),
            (at_target(checked(f.source_uv)), f"transferred to {t.name}"),
        ],
        [
            (at_source(lambda blend: blend(colours)), "colours of position"),
            (at_target(lambda blend: blend(carried)), f"transferred to {t.name}"),
        ],
    ]
    save_figure(panels(*rows), path)


def distortion_picture(path: str | Path, f: SurfaceMap) -> None:
    """Symmetric Dirichlet on the source and on its image, with its histogram."""
    s = f.source.surface
    value = symmetric_dirichlet(
        triangle_metric(s.vertices, s.faces), triangle_metric(f.image, s.faces)
    ).numpy()
    at_vertex = vertex_means(np.minimum(value, 1e3), s.faces, len(s.vertices))
    scale = ScalarMappable(LogNorm(_LEAST, _WORST), "viridis")
    colours = scale.to_rgba(at_vertex)[:, :3]

    def paint(blend: Blend) -> np.ndarray:
        return blend(colours)

    view = View(s.vertices, PANEL)
    image = f.aligned_image
    other = View(image, PANEL, frame=view.frame)
    figure = panels(
        [
            (view.draw(s.vertices, s.faces, paint, s.seam_pairs), f"{s.name}: symmetric Dirichlet"),
            (
                other.draw(image, s.faces, paint, s.seam_pairs),
                f"its image on {f.target.surface.name}",
            ),
            (np.ones((PANEL, PANEL, 3)), ""),
        ]
    )
    axes = figure.axes[2]
    axes.clear()
    axes.set_aspect("auto")
    axes.set_position((0.64, 0.14, 0.24, 0.74))
    axes.hist(
        np.clip(value, _LEAST, _WORST), bins=np.geomspace(_LEAST, _WORST, 60), color="#345c8c"
    )
    axes.set_xscale("log")
    axes.set_xticks(_TICKS, [*map(str, _TICKS[:-1]), f"≥ {_TICKS[-1]}"])
    axes.set_xticks([], minor=True)
    axes.set_title(f"triangles; median {np.median(value):.2f}")
    bar = figure.colorbar(scale, cax=figure.add_axes((0.91, 0.2, 0.012, 0.6)), extend="max")
    bar.set_ticks(_TICKS, labels=map(str, _TICKS))
    bar.ax.set_yticks([], minor=True)
    save_figure(figure, path)


def morph_pictures(strip: str | Path, animation: str | Path, f: SurfaceMap) -> None:
    """The morph from source to target: five pictures in a row, and a GIF, back and forth."""
    s = f.source.surface
    both = np.concatenate([s.vertices, f.aligned_image])
    frame = View(s.vertices, 8).frame

    def draw(t: float, size: int) -> np.ndarray:
        view = View(both, size, frame=frame)
        return np.round(255 * view.draw(f.morph(t), s.faces, checked(s.uv), s.seam_pairs)).astype(
            np.uint8
        )

    row = np.concatenate([draw(t, _STRIP) for t in np.linspace(0, 1, 5)], axis=1)
    data = io.BytesIO()
    Image.fromarray(row).save(data, format="PNG")
    atomic_write(strip, data.getvalue())
    frames = [Image.fromarray(draw(t, _GIF)) for t in np.linspace(0, 1, 9)]
    frames += frames[-2:0:-1]
    data = io.BytesIO()
    frames[0].save(
        data, format="GIF", save_all=True, append_images=frames[1:], duration=120, loop=0
    )
    atomic_write(animation, data.getvalue())


def map_image(source: Surface, target: Surface, image_uv: np.ndarray) -> np.ndarray:
    """A quick picture (384, 384, 3) uint8: the source's checkerboard on its image."""
    image = target.at(image_uv)
    view = View(target.vertices, 384)
    return np.round(255 * view.draw(image, source.faces, checked(source.uv))).astype(np.uint8)
