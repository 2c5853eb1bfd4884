"""Landmarks as coloured spheres in pictures of meshes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib import colormaps

from nsm.results.render import Blend
from nsm.surfaces.shapes import sphere

_RADIUS = 0.016  # of the diagonal of the mesh's bounding box


class Spheres:
    """A mesh with a sphere at each of some vertices.

    Args:
        vertices, faces: the mesh (V, 3), (F, 3).
        at: (L,) vertices, -1 for none; each sphere has a colour of its own, by its number and L.

    Attributes:
        mesh: vertices and faces of the mesh and, behind them, of the spheres.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, at: np.ndarray) -> None:
        ball, triangles = sphere(2)
        radius = _RADIUS * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        (there,) = np.nonzero(at >= 0)
        first = len(vertices) + len(ball) * np.arange(len(there))
        every = (vertices[at[there]][:, None] + radius * ball).reshape(-1, 3)
        more = (triangles[None] + first[:, None, None]).reshape(-1, 3)
        self.mesh = np.concatenate([vertices, every]), np.concatenate([faces, more])
        colours = colormaps["hsv"](there / max(1, len(at)))[:, :3]
        self._colours = np.zeros((len(vertices) + len(every), 4))
        self._colours[len(vertices) :, :3] = np.repeat(colours, len(ball), axis=0)
        self._colours[len(vertices) :, 3] = 1
        self._count = len(vertices)

    def painted(self, paint: Callable[[Blend], np.ndarray]) -> Callable[[Blend], np.ndarray]:
        """Colours for :meth:`nsm.results.render.View.draw` of ``mesh``: the mesh's, painted as
        it is alone, and those of the spheres."""

        def colours(blend: Blend) -> np.ndarray:
            def of_mesh(values: np.ndarray) -> np.ndarray:
                filled = np.zeros((len(self._colours), *values.shape[1:]))
                filled[: self._count] = values
                return blend(filled)

            own = blend(self._colours)
            shown = np.empty((len(own), 3))
            shown[:] = paint(of_mesh)
            on_sphere = own[:, 3] > 0.5
            shown[on_sphere] = own[on_sphere, :3]
            return shown

        return colours
