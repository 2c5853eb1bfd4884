"""Seams optimized together with the map: after each map, both shapes are cut anew.

A map takes the source's seam to the target's, wherever these happen to lie. Here a map is used to
find a tree of paths on the source that is short on both shapes, and the corresponding paths on the
target; both shapes are cut along these and mapped again. What the first seam fixed can then move.

    python benchmarks/redrawn_seam.py --meshes FOLDER [--pair 384 388] [--rounds 2]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

import nsm
from nsm.domains import Disc, Keys
from nsm.domains.common_cut import common_fractions
from nsm.domains.common_seams import (
    aligned_keys,
    boundary_keys,
    corresponding_paths,
    edge_lengths,
)
from nsm.results import by_file_vertex
from nsm.surfaces import topology
from nsm.surfaces.cutting import cut_along_paths
from nsm.surfaces.landmark_files import read_landmarks
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.validation import CleanMesh, clean

RESULTS = Path(__file__).parent / "results" / "redrawn_seam"
_ASTRAY = 0.01  # of the diagonal: distance from its line at which a path costs twice as much
_FIGURES = (
    "symmetric_dirichlet_median",
    "symmetric_dirichlet_mean",
    "symmetric_dirichlet_p95",
    "flipped_before_repair_percent",
    "flipped_percent",
    "landmark_error_max_percent",
    "seam_gap_mean_percent",
)


def along(mesh: CleanMesh, line: np.ndarray) -> np.ndarray:
    """(E,) costs of edges that make a path follow a line of points (N, 3)."""
    pairs = topology.edges_of(mesh.faces).pairs
    middle = mesh.vertices[pairs].mean(axis=1)
    diagonal = np.linalg.norm(np.ptp(mesh.vertices, axis=0))
    astray = cKDTree(line).query(middle)[0] / (_ASTRAY * diagonal)
    return edge_lengths(mesh.vertices, mesh.faces) * (1 + astray**2)


def line_through(points: np.ndarray, paths: list[list[int]]) -> np.ndarray:
    """Densely spaced points along paths of vertices."""
    share = np.linspace(0, 1, 9)[:, None, None]
    parts = []
    for path in paths:
        corners = points[path]
        parts.append((corners[:-1] * (1 - share) + corners[1:] * share).reshape(-1, 3))
    return np.concatenate(parts)


def redrawn(
    meshes: list[CleanMesh], names: list[str], ids: list[np.ndarray], image: np.ndarray
) -> list[nsm.Surface]:
    """Both meshes, cut along seams that correspond under a map.

    Args:
        meshes: source and target.
        names: of the meshes.
        ids: landmarks (L,) on the seam, of each mesh.
        image: (V, 3), the images of the source's vertices on the target.
    """
    source, target = meshes
    pairs = topology.edges_of(source.faces).pairs
    there = np.linalg.norm(image[pairs[:, 0]] - image[pairs[:, 1]], axis=1)
    units = [np.sqrt(topology.face_areas(m.vertices, m.faces).sum()) for m in meshes]
    cost = edge_lengths(source.vertices, source.faces) / units[0] + there / units[1]
    first = corresponding_paths([(source.vertices, source.faces)], ids[:1], [cost])
    assert first is not None
    lines = [line_through(points, first[0]) for points in (source.vertices, image)]
    costs = [along(mesh, line) for mesh, line in zip(meshes, lines, strict=True)]
    paths = corresponding_paths([(m.vertices, m.faces) for m in meshes], ids, costs)
    assert paths is not None
    cuts = [
        cut_along_paths(m.vertices, m.faces, p, name=n)
        for m, p, n in zip(meshes, paths, names, strict=True)
    ]
    keys = aligned_keys(
        [boundary_keys(cut.origin, cut.loop, v) for cut, v in zip(cuts, ids, strict=True)]
    )
    assert keys is not None
    on_boundary = [k[:, 1] for k in keys]
    fractions = common_fractions(cuts, on_boundary, Disc())
    return [
        nsm.Surface.from_cut(
            cut,
            mesh,
            name=name,
            domain="disc",
            parameterization="slim",
            keys=Keys(key, fractions),
        )
        for cut, mesh, name, key in zip(cuts, meshes, names, on_boundary, strict=True)
    ]


def study(meshes: Path, pair: list[str], rounds: int) -> list[dict[str, Any]]:
    """Figures of the map with the seams of ``seam.path=auto``, and after each round."""
    names = [f"shrec07-{name}" for name in pair]
    files = [str(meshes / f"{name}.off") for name in names]
    marks = [str(meshes / "landmarks" / f"{name}.vts") for name in names]
    cleaned = [clean(*load_mesh(file)[:2], name) for file, name in zip(files, names, strict=True)]
    landmarks = np.stack([read_landmarks(file) for file in marks], axis=1)
    f = nsm.map_pair(*files, marks, progress=False)
    found = [{key: f.metrics[key] for key in _FIGURES}]
    boundary = topology.boundary_loops(f.source.surface.faces)[0]
    on_seam = np.isin(landmarks[:, 0], f.source.surface.source_vertex[boundary])
    for _ in range(rounds):
        image = by_file_vertex(f.source.surface, f.target.in_original_units(f.image))
        ids = [cleaned[k].merged[landmarks[on_seam, k]] for k in (0, 1)]
        of_clean = image[cleaned[0].source_vertex]
        surfaces = redrawn(cleaned, names, ids, of_clean)
        phis = [nsm.overfit(surface, progress=False) for surface in surfaces]
        f = nsm.map_pair(*phis, landmarks.tolist(), progress=False)
        found.append({key: f.metrics[key] for key in _FIGURES})
        print(found[-1], flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    parser.add_argument("--pair", nargs=2, default=["384", "388"])
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    if not arguments.meshes.is_dir():
        parser.error(f"{arguments.meshes}: no such folder; give one with --meshes")
    found = {
        "pair": arguments.pair,
        "torch": torch.__version__,
        "rounds": study(arguments.meshes, arguments.pair, arguments.rounds),
    }
    RESULTS.mkdir(parents=True, exist_ok=True)
    file = RESULTS / f"{'-'.join(arguments.pair)}.json"
    file.write_text(json.dumps(found, indent=2) + "\n")
    print(file.read_text())


if __name__ == "__main__":
    main()
