"""From the faces of a mesh file to those of the surface prepared from it, and back.

The preparation merges vertices, removes faces, cuts seams and may split faces along them. A face
that has stayed whole is found by its vertices. Points of others go to the nearest point.
"""

from __future__ import annotations

import numpy as np

from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.surfaces.location import Places, locate
from nsm.surfaces.topology import equal_faces

_SAME = 1e-5  # of the mesh's size: vertices of one mesh in files of single precision


class FileFaces:
    """The faces of a mesh file beside those of a surface.

    Args:
        surface: prepared from the mesh.
        vertices, faces: (W, 3) and (G, 3), as :func:`nsm.surfaces.loading.load_mesh` gives them.
        name: of the mesh, in errors.

    Raises:
        NsmError: ``wrong_mesh``: the surface was made from another mesh.
    """

    def __init__(
        self, surface: Surface, vertices: np.ndarray, faces: np.ndarray, name: str
    ) -> None:
        self.surface, self.file_faces = surface, faces
        self.file_vertices = (vertices - surface.center) * surface.scale
        self._check(name)
        row = surface.cut_vertex
        # vertices of the file, with merged ones as the one they were merged with
        kept = np.where(row >= 0, surface.source_vertex[row], -1)
        there, here = kept[faces], surface.source_vertex[surface.faces]
        file_face, surface_face = equal_faces(there, here)
        self._surface_face = np.full(len(faces), -1)
        self._surface_face[file_face] = surface_face
        self._file_face = np.full(len(here), -1)
        self._file_face[surface_face] = file_face
        # corner k of the surface's face is corner _corner[face, k] of the file's
        same = here[:, :, None] == there[self._file_face][:, None, :]
        self._corner = same.argmax(axis=2)

    def _check(self, name: str) -> None:
        s = self.surface
        known = np.flatnonzero(s.source_vertex >= 0)
        if len(self.file_vertices) == len(s.cut_vertex):
            off = self.file_vertices[s.source_vertex[known]] - s.vertices[known]
            if np.abs(off).max(initial=0.0) < _SAME * s.bounding_box_diagonal:
                return
        raise NsmError(
            f"{name}: not the mesh from which {s.name} was prepared; give that file",
            kind="wrong_mesh",
            key=name,
        )

    def to_file(self, places: Places) -> Places:
        """Places on the surface as places on the file's mesh."""
        face = self._file_face[places.face]
        weights = np.zeros_like(places.weights)
        np.put_along_axis(weights, self._corner[places.face], places.weights, axis=1)
        lost = np.flatnonzero(face < 0)
        if len(lost):
            s = self.surface
            chosen = np.flatnonzero(self._surface_face < 0)
            if len(chosen) == 0:
                chosen = np.arange(len(self.file_faces))
            points = Places(places.face[lost], places.weights[lost]).take(s.vertices, s.faces)
            near = locate(points, self.file_vertices, self.file_faces[chosen])
            face[lost], weights[lost] = chosen[near.face], near.weights
        return Places(face, weights)

    def to_surface(self, places: Places) -> Places:
        """Places on the file's mesh as places on the surface, the nearest ones to removed faces."""
        face = self._surface_face[places.face]
        weights = np.take_along_axis(places.weights, self._corner[face], axis=1)
        lost = np.flatnonzero(face < 0)
        if len(lost):
            s = self.surface
            given = Places(places.face[lost], places.weights[lost])
            near = locate(given.take(self.file_vertices, self.file_faces), s.vertices, s.faces)
            face[lost], weights[lost] = near
        return Places(face, weights)
