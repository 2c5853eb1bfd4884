"""Shapes with limbs, whose tips are known."""

import numpy as np
import trimesh

# directions of limbs, and their lengths: no symmetry takes them to one another
LIMBS = {
    (1.0, 0.0, 0.2): 2.6,
    (-0.3, 1.0, 0.0): 1.9,
    (-0.8, -0.7, 0.1): 1.3,
    (0.1, -0.2, 1.0): 1.6,
    (0.3, -0.9, -0.6): 2.2,
}


def star(lengths, width=0.35):
    """A ball with limbs, as vertices and faces, and the vertices at the limbs' tips."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    points = np.array(ball.vertices)
    along = np.array(list(LIMBS)) / np.linalg.norm(list(LIMBS), axis=1)[:, None]
    angle = np.arccos(np.clip(points @ along.T, -1, 1))
    radius = 1 + np.exp(-((angle / width) ** 2)) @ np.array(lengths)
    return radius[:, None] * points, np.array(ball.faces), angle.argmin(axis=0)
