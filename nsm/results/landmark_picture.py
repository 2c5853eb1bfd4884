"""The landmarks of a map with their numbers, to be looked at before the training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nsm.domains import Surface
from nsm.results.pictures import PANEL, panels, save_figure
from nsm.results.render import View
from nsm.results.spheres import Spheres

_GREY = 0.75


def landmarks_picture(
    path: str | Path, surfaces: Sequence[Surface], landmarks: Sequence[np.ndarray]
) -> None:
    """Surfaces side by side, with a sphere and the number, from 0, of each landmark.

    Numbers on the far side are pale.

    Args:
        path: of the picture.
        surfaces: two or more.
        landmarks: of each, vertices (L,) of its mesh file; negative ones are missing.
    """
    figure = panels([(_drawn(s, ids), s.name) for s, ids in zip(surfaces, landmarks, strict=True)])
    for axes, surface, ids in zip(figure.axes, surfaces, landmarks, strict=True):
        pixels, depth = View(surface.vertices, PANEL).pixels(surface.vertices)
        middle = np.median(depth)
        for number in np.flatnonzero(ids >= 0).tolist():
            at = surface.cut_vertex[ids[number]]
            words = {"textcoords": "offset points", "fontsize": 11}
            pale = 1.0 if depth[at] > middle else 0.4
            axes.annotate(str(number), pixels[at], (4, 4), **words, alpha=pale)
    save_figure(figure, path)


def _drawn(surface: Surface, ids: np.ndarray) -> np.ndarray:
    """A surface with spheres at landmarks (L,), of one colour on all surfaces."""
    vertices = surface.vertices
    spheres = Spheres(vertices, surface.faces, np.where(ids >= 0, surface.cut_vertex[ids], -1))
    paint = spheres.painted(lambda blend: np.full((len(blend(vertices)), 3), _GREY))
    return View(vertices, PANEL).draw(*spheres.mesh, paint, surface.seam_pairs)
