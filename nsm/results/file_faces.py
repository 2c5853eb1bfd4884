"""From the faces of a mesh file to those of the surface prepared from it, and back.

The preparation merges vertices, removes faces, cuts seams and may split faces along them. A face
that has stayed whole is found by its vertices. Points of others go to the nearest point.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nsm.domains import Surface
from nsm.domains.caps import on_caps
from nsm.errors import NsmError
from nsm.surfaces.location import Places, locate
from nsm.surfaces.topology import equal_faces

if TYPE_CHECKING:
    from nsm.results.artifact import NeuralSurface

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
        """Places on the surface as places on the file's mesh, the nearest ones to filled holes, and
        none on caps."""
        s = self.surface
        absent = (places.face < 0) | on_caps(s, places.face)
        if absent.any():
            return places.where(~absent, self.to_file)
        face = self._file_face[places.face]
        weights = np.zeros_like(places.weights)
        np.put_along_axis(weights, self._corner[places.face], places.weights, axis=1)
        lost = np.flatnonzero(face < 0)
        over = s.filled[places.face[lost]]
        every, split = np.arange(len(self.file_faces)), np.flatnonzero(self._surface_face < 0)
        for rows, chosen in ((lost[~over], split if len(split) else every), (lost[over], every)):
            if len(rows):
                points = Places(places.face[rows], places.weights[rows]).take(s.vertices, s.faces)
                near = locate(points, self.file_vertices, self.file_faces[chosen])
                face[rows], weights[rows] = chosen[near.face], near.weights
        return Places(face, weights)

    def to_surface(self, places: Places) -> Places:
        """Places on the file's mesh as places on the surface, the nearest ones to removed faces."""
        absent = places.face < 0
        if absent.any():
            return places.where(~absent, self.to_surface)
        face = self._surface_face[places.face]
        weights = np.take_along_axis(places.weights, self._corner[face], axis=1)
        lost = np.flatnonzero(face < 0)
        if len(lost):
            s = self.surface
            given = Places(places.face[lost], places.weights[lost])
            near = locate(given.take(self.file_vertices, self.file_faces), s.vertices, s.faces)
            face[lost], weights[lost] = near
        return Places(face, weights)


def same_mesh(one: NeuralSurface, other: NeuralSurface) -> bool:
    """Whether two surfaces were prepared from one mesh, perhaps cut or laid out differently."""
    if one is other:
        return True
    (a, f), (b, g) = one.file_mesh(), other.file_mesh()
    if one.surface.raw is None or other.surface.raw is None:
        # the file's order of faces is lost
        f, g = (np.unique(np.sort(faces, axis=1), axis=0) for faces in (f, g))
    if a.shape != b.shape or not np.array_equal(f, g):
        return False
    size = float(np.ptp(a, axis=0).max(initial=0.0))
    return bool(np.abs(a - b).max(initial=0.0) <= _SAME * size)


def faces_of_file(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """The surface's faces as they are in the mesh file: in its order, by its vertex numbers.

    Faces that the preparation added, such as those over a hole, are left out. An older version's
    surface has lost the file's order.

    Returns:
        Faces (G, 3) of vertices of the file, and the same corners (G, 3) as vertices of the
        surface, whose copies at a seam are told apart.
    """
    faces, corners = surface.file_faces()
    if surface.raw is None:
        return faces, corners
    given = surface.raw[1]
    row = surface.cut_vertex
    kept = np.where(row >= 0, surface.source_vertex[row], -1)[given]
    file_face, own_face = equal_faces(kept, faces)
    order = np.argsort(file_face, kind="stable")
    file_face, own_face = file_face[order], own_face[order]
    same = kept[file_face][:, :, None] == faces[own_face][:, None, :]
    return given[file_face], np.take_along_axis(corners[own_face], same.argmax(axis=2), axis=1)
