"""Meshes that come inside installed packages, so that they need no network."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from nsm.errors import NsmError
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.shapes import Mesh, grid_faces

METRES_PER_DEGREE = 111_195.0  # of latitude, on a sphere of the Earth's mean radius


def terrain(stride: int = 3) -> Mesh:
    """Elevation model of the Jacksboro fault, Tennessee (matplotlib's sample data), in metres.

    x runs east and y north, about 30 x 32 km, z is the height, not exaggerated. Every stride-th
    row and column of the 344 x 403 grid is taken: 15 525 vertices with 3.
    """
    file = _package_file("matplotlib", ["mpl-data/sample_data/jacksboro_fault_dem.npz"], "")
    with np.load(file) as data:
        height = data["elevation"].astype(np.float64)
        north, south = float(data["ymin"]), float(data["ymax"])  # named by row: the first is north
        step_x, step_y = float(data["dx"]), float(data["dy"])
    latitude = np.radians(0.5 * (north + south))
    rows, columns = height.shape
    x = np.arange(columns) * step_x * METRES_PER_DEGREE * np.cos(latitude)
    y = np.arange(rows) * step_y * METRES_PER_DEGREE
    height = height[::-1]  # rows from south to north, as y grows
    grid_y, grid_x = np.meshgrid(y[::stride], x[::stride], indexing="ij")
    z = height[::stride, ::stride]
    return np.stack([grid_x, grid_y, z], axis=-1).reshape(-1, 3), grid_faces(*z.shape)


def brain() -> Mesh:
    """Left pial surface of FreeSurfer's fsaverage5 (nilearn's copy), in millimetres, closed."""
    file = _package_file(
        "nilearn",
        [f"datasets/data/fsaverage5/pial{mark}left.gii.gz" for mark in "_."],
        "brain",
    )
    if find_spec("nibabel") is None:
        raise NsmError("nibabel is not installed; pip install nsm[brain]")
    import nibabel

    points, triangles = nibabel.load(file).agg_data(("pointset", "triangle"))  # type: ignore[attr-defined]
    return np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.int64)


def pyvista_example(name: str) -> Mesh:
    """One of the PLY files among pyvista's examples, as it is there."""
    vertices, faces, _ = load_mesh(_package_file("pyvista", [f"examples/{name}.ply"], "pyvista"))
    return vertices, faces


def _package_file(package: str, candidates: list[str], extra: str) -> Path:
    """The first of the candidate files inside a package, found without importing it.

    NsmError if the package or the file is missing; extra is the optional extra that brings it.
    """
    mend = f"pip install nsm[{extra}]" if extra else f"pip install --force-reinstall {package}"
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise NsmError(f"{package} is not installed; {mend}")
    for folder in spec.submodule_search_locations:
        for candidate in candidates:
            file = Path(folder) / candidate
            if file.exists():
                return file
    raise NsmError(f"{package} is installed without {candidates[0]}; {mend}")
