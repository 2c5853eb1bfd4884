"""A mesh laid out over a domain Ω, on which points of Ω are looked up."""

from __future__ import annotations

import numpy as np

from nsm.surfaces.location import Locator, Places


class Layout:
    """What is prepared of the mesh serves all calls.

    Args:
        uv: (V, 2) its vertices, in Ω.
        faces: (F, 3).
    """

    def __init__(self, uv: np.ndarray, faces: np.ndarray) -> None:
        self.uv, self.faces = uv, faces
        self._mesh = Locator(uv, faces)

    def locate(self, points: np.ndarray) -> Places:
        """The nearest places to points (N, 2) of Ω."""
        return self._mesh.locate(points)

    def carried(self, points: np.ndarray, after: np.ndarray, copies: np.ndarray) -> np.ndarray:
        """Images (N, 2) of points (N, 2) under the map that is linear on the triangles.

        Args:
            points: of Ω; on a closed domain in any lift, and the images are in the lift that the
                map sends them to.
            after: (V, 2) the images of the vertices.
            copies: as for :meth:`nsm.domains.Domain.certificate`.
        """
        return self.locate(points).take(after, self.faces)
