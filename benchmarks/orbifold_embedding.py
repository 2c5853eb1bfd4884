"""Closed shapes laid out on the flat orbifold: time, distortion and flips.

    python benchmarks/orbifold_embedding.py [../shared/meshes] [--only NAME ...]

Seconds are of the processor, on one thread: choosing four cones among the surface's extremities,
and the embedding from the raw mesh. Distortion is symmetric Dirichlet (ε = 0.01) of the map from
the mesh to the domain's plane, both of the same area: median and 95th percentile over triangles.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from nsm.domains.orbifold.cones import choose_cones
from nsm.domains.orbifold.embedding import embed_orbifold
from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.loading import EXTENSIONS, load_mesh

_HEADER = ("mesh", "vertices", "cones s", "embed s", "median", "95 %", "flips", "aspect")
_ROW = "{:<18}{:>10}{:>9}{:>9}{:>9}{:>9}{:>7}{:>8}"


def closed_sphere(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """The mesh, with vertices where only corners touch split, if it is closed and of genus 0."""
    vertices, faces, _ = load_mesh(path)
    edges = topology.edges_of(faces)
    if not (edges.count == 2).all() or topology.face_components(faces).max() > 0:
        return None
    faces, origin = topology.cut_along(faces, np.zeros(len(edges.pairs), dtype=bool))
    if topology.euler_characteristic(faces) != 2:
        return None
    return vertices[origin], faces


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", default="../shared/meshes", type=Path)
    parser.add_argument("--only", nargs="*", help="names of meshes")
    options = parser.parse_args()
    print(_ROW.format(*_HEADER))
    medians, tails = [], []
    for path in sorted(options.folder.iterdir()):
        if path.suffix not in EXTENSIONS or (options.only and path.stem not in options.only):
            continue
        mesh = closed_sphere(path)
        if mesh is None:
            continue
        vertices, faces = mesh
        start = time.process_time()
        try:
            cones, _ = choose_cones(vertices, faces)
            chosen = time.process_time()
            embedding = embed_orbifold(vertices, faces, cones.tolist(), keep_order=False)
        except NsmError as error:
            print(f"{path.stem:<18} {error}")
            continue
        embedded = time.process_time()
        median, tail = np.percentile(embedding.distortions(vertices), [50, 95])
        medians.append(median)
        tails.append(tail)
        lengths = np.linalg.norm(embedding.lattice, axis=0)
        print(
            _ROW.format(
                path.stem,
                len(vertices),
                f"{chosen - start:.1f}",
                f"{embedded - chosen:.1f}",
                f"{median:.2f}",
                f"{tail:.1f}",
                int(embedding.certificate().flipped.sum()),
                f"{lengths.max() / lengths.min():.2f}",
            ),
            flush=True,
        )
    print(f"means: median {np.mean(medians):.2f}, 95th percentile {np.mean(tails):.1f}")


if __name__ == "__main__":
    main()
