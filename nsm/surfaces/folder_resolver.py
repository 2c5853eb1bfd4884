"""The files that a mesh file names, for trimesh."""

from __future__ import annotations

from pathlib import Path

from trimesh.resolvers import Resolver

from nsm.surfaces.folder_files import read_below


class FolderResolver(Resolver):
    """Reads the files that a mesh file names, but only from its folder and the folders below.

    Args:
        folder: the folder of the mesh file.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, key: str) -> bytes:
        """The contents of a file.

        Raises:
            ValueError: as :func:`nsm.surfaces.folder_files.read_below`.
        """
        return read_below(self.folder, str(key))

    def write(self, name: str, data: bytes) -> None:
        """Refuse to write."""
        raise ValueError("reading a mesh writes nothing")

    def namespaced(self, namespace: str) -> FolderResolver:
        """The resolver of a folder below."""
        return FolderResolver(self.folder / namespace)

    def keys(self) -> list[str]:
        """Nothing: the files are not listed."""
        return []
