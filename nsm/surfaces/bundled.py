"""Meshes inside installed packages, which need no network."""

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

    x points east and y north, over about 30 x 32 km; z is the height, not exaggerated. The mesh
    has every stride-th row and column of the 344 x 403 grid: 15 525 vertices with 3.

    Raises:
        NsmError: ``missing_package``, here and below.
    """
    file = _package_file("matplotlib", ["mpl-data/sample_data/jacksboro_fault_dem.npz"], "")
    with np.load(file) as data:
        height = data["elevation"].astype(np.float64)
        north, south = float(data["ymin"]), float(data["ymax"])  # swapped: the first row is north
        step_x, step_y = float(data["dx"]), float(data["dy"])
    latitude = np.radians(0.5 * (north + south))
    rows, columns = height.shape
    x = np.arange(columns) * step_x * METRES_PER_DEGREE * np.cos(latitude)
    y = np.arange(rows) * step_y * METRES_PER_DEGREE
    height = height[::-1]  # rows from south to north
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
        raise _missing("nibabel is not installed", "pip install nsm[brain]", "nibabel")
    import nibabel

    points, triangles = nibabel.load(file).agg_data(("pointset", "triangle"))  # type: ignore[attr-defined]
    return np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.int64)


def pyvista_example(name: str) -> Mesh:
    """One of the PLY files among pyvista's examples, unchanged."""
    vertices, faces, _ = load_mesh(_package_file("pyvista", [f"examples/{name}.ply"], "pyvista"))
    return vertices, faces


def _package_file(package: str, candidates: list[str], extra: str) -> Path:
    """The first of the candidate files that a package has, without importing the package.

    The extra is the one of nsm that installs the package.
    """
    remedy = f"pip install nsm[{extra}]" if extra else f"pip install --force-reinstall {package}"
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise _missing(f"{package} is not installed", remedy, package)
    for folder in spec.submodule_search_locations:
        for candidate in candidates:
            file = Path(folder) / candidate
            if file.exists():
                return file
    raise _missing(f"{package} is installed without {candidates[0]}", remedy, package)


def _missing(reason: str, remedy: str, package: str) -> NsmError:
    return NsmError(f"{reason}; {remedy}", kind="missing_package", key=package)
