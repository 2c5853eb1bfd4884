"""Pictures of collections: matrices of all ordered pairs."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from nsm.results.collection import SurfaceCollection
from nsm.results.pictures import checked, panels, save_figure
from nsm.results.render import View

_SHOWN = {
    "symmetric_dirichlet_median": "symmetric Dirichlet, median",
    "flipped_percent": "flipped triangles, %",
    "landmark_error_max_percent": "largest landmark error, % of diagonal",
}
_CELL = 300
# the picture of a larger collection would take hundreds of megabytes
_MOST_DRAWN = 8


def figures_picture(path: str | Path, collection: SurfaceCollection) -> None:
    """The main figures of every ordered pair, from row to column."""
    names, k = collection.names, len(collection)
    side = max(5.0, 0.5 * k)  # inches: the numbers do not overlap
    every = {key for figures in collection.metrics["pairs"].values() for key in figures}
    shown = {key: title for key, title in _SHOWN.items() if key in every}
    figure = Figure(figsize=((side + 0.2) * len(shown), side), dpi=120)
    figure.set_layout_engine("constrained", w_pad=0.1, h_pad=0.15)  # inches
    for n, (key, title) in enumerate(shown.items()):
        values = np.full((k, k), np.nan)
        for i in range(k):
            for j in range(k):
                if i != j:
                    figures = collection.metrics["pairs"][collection.pair_names[i, j]]
                    values[i, j] = figures.get(key, np.nan)
        axes = figure.add_subplot(1, len(shown), n + 1)
        axes.imshow(values, cmap="viridis_r")
        middle = np.nanmean([np.nanmin(values), np.nanmax(values)])
        for i in range(k):
            for j in range(k):
                if i != j:
                    colour = "white" if values[i, j] > middle else "black"
                    axes.text(j, i, f"{values[i, j]:.3g}", ha="center", va="center", color=colour)
        axes.set_xticks(range(k), names, rotation=30, ha="right")
        axes.set_yticks(range(k), names)
        axes.set_title(title)
        axes.set(xlabel="target", ylabel="source")
    save_figure(figure, path)


def transfer_matrix_picture(path: str | Path, collection: SurfaceCollection) -> None:
    """Row i, column j: the checkerboard of surface i on surface j, for the first eight."""
    rows = []
    drawn = collection.surfaces[:_MOST_DRAWN]
    views = [View(phi.surface.vertices, _CELL) for phi in drawn]
    for i, source in enumerate(drawn):
        row = []
        for j, target in enumerate(drawn):
            t = target.surface
            uv = source.surface.uv if i == j else collection.pair(i, j).source_uv
            title = collection.names[i] if i == j else collection.pair_names[i, j]
            row.append((views[j].draw(t.vertices, t.faces, checked(uv), t.seam_pairs), title))
        rows.append(row)
    save_figure(panels(*rows), path)


def cycle_picture(path: str | Path, collection: SurfaceCollection) -> None:
    """The checkerboard of the first surface, carried to the second, the third and back to the
    first."""
    drawn = []
    ring = [0, 1, 2, 0]
    for end in range(len(ring)):
        last = collection.surfaces[ring[end]].surface
        uv = last.uv
        for source, target in reversed(list(itertools.pairwise(ring[: end + 1]))):
            f, s = collection.pair(source, target), collection.surfaces[source].surface
            uv = f.image_layout.carried(uv, s.uv, s.seam_pairs)
        view = View(last.vertices, _CELL)
        title = " → ".join(collection.names[k] for k in ring[max(0, end - 1) : end + 1])
        drawn.append((view.draw(last.vertices, last.faces, checked(uv), last.seam_pairs), title))
    save_figure(panels(drawn), path)
