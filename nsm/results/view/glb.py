"""Shapes as GLB, for the browser."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from trimesh.visual.color import srgb_to_linear

from nsm.results.textures import checkerboard
from nsm.results.view.scene import Paint, Shape


def as_glb(shape: Shape, vertices: np.ndarray, paint: Paint) -> bytes:
    """A shape with its vertices at (V, 3), painted, double-sided and with smooth normals."""
    colours = np.ones((len(vertices), 4))
    texture: dict[str, Any] = {}
    coordinates = np.zeros((len(vertices), 2))
    if paint.colours is not None:
        colours[:, :3] = srgb_to_linear(np.clip(paint.colours, 0, 1))  # as glTF expects
    if paint.checkerboard is not None:
        coordinates = 0.5 * (paint.checkerboard + 1)
        texture["baseColorTexture"] = checkerboard()
    visual = trimesh.visual.TextureVisuals(
        uv=coordinates,
        material=trimesh.visual.material.PBRMaterial(
            metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True, **texture
        ),
    )
    visual.vertex_attributes["color"] = np.round(255 * colours).astype(np.uint8)
    mesh = trimesh.Trimesh(
        vertices,
        shape.faces,
        vertex_normals=shape.normals(vertices),
        visual=visual,
        process=False,
    )
    data = trimesh.Scene(mesh).export(file_type="glb", include_normals=True)
    assert isinstance(data, bytes)
    return data
