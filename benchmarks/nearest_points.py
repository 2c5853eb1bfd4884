"""The simplest outside mapper, for benchmarks/peers.py and as a pattern of an adapter.

The source is moved, turned and scaled so that its landmarks are nearest to the target's; each of
its vertices then takes the nearest point of the target:

    python nearest_points.py SOURCE TARGET LANDMARKS IMAGE
"""

from __future__ import annotations

import sys

import igl
import numpy as np
import trimesh


def main() -> None:
    source, target, landmarks, image = sys.argv[1:]
    vertices, other = (trimesh.load_mesh(file, process=False) for file in (source, target))
    pairs = np.loadtxt(landmarks, dtype=int, ndmin=2)
    ends = vertices.vertices[pairs[:, 0]], other.vertices[pairs[:, 1]]
    matrix, _, _ = trimesh.registration.procrustes(*ends, reflection=False)
    moved = trimesh.transform_points(vertices.vertices, matrix)
    near = igl.point_mesh_squared_distance(
        np.ascontiguousarray(moved), np.ascontiguousarray(other.vertices), np.array(other.faces)
    )[2]
    np.savetxt(image, near)


if __name__ == "__main__":
    main()
