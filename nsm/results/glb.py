"""Meshes as GLB, which every viewer shows alike: matt, and from both sides."""

from __future__ import annotations

from typing import Any

import numpy as np
from PIL import Image

VERTICES, FACES = 34962, 34963  # what a view of the buffer is for


def as_glb(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    uv: np.ndarray | None = None,
    image: Image.Image | None = None,
    colours: np.ndarray | None = None,
    normals: np.ndarray | None = None,
) -> bytes:
    """A mesh with one material, in single precision.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        uv: (V, 2) texture coordinates; (0, 0) is the lower left corner of the image.
        image: the texture; transparent where it has an alpha channel.
        colours: (V, 3) in sRGB, [0, 1]; they multiply the texture's.
        normals: (V, 3); without them, programs shade each triangle flat.
    """
    import trimesh

    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=image,
        metallicFactor=0.0,  # by default a mirror, black where there is nothing to reflect
        roughnessFactor=1.0,
        doubleSided=True,
        alphaMode="BLEND" if image is not None and image.mode == "RGBA" else None,
    )
    visual: Any = trimesh.visual.TextureVisuals(uv=uv, material=material)
    if colours is not None:
        # linear, unlike those of a texture (glTF 2.0, 3.9.2)
        linear = trimesh.visual.color.srgb_to_linear(np.clip(colours, 0, 1))
        opaque = np.column_stack([linear, np.ones(len(linear))])
        visual.vertex_attributes["color"] = np.rint(255 * opaque).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)
    data = trimesh.Scene(mesh).export(
        file_type="glb", include_normals=normals is not None, tree_postprocessor=_say_targets
    )
    assert isinstance(data, bytes)
    return data


def _say_targets(tree: dict[str, Any]) -> None:
    """Say of the buffer's views whether they hold vertices or faces, as the format advises."""
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            uses = [(primitive["indices"], FACES)]
            uses += [(accessor, VERTICES) for accessor in primitive["attributes"].values()]
            for accessor, use in uses:
                tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["target"] = use
