"""What a map that is not certified says of its faults: where they are, why, and what to do."""

from __future__ import annotations

import numpy as np
from rich.text import Text

from nsm.domains.planar_mesh import flipped
from nsm.results.surface_map import SurfaceMap
from nsm.surfaces.topology import face_areas

# height over length below which a triangle is a needle: no map of it has digits to spare
_NEEDLE = 1e-6


def warning_of_faults(name: str, f: SurfaceMap) -> Text | None:
    """A line in red that says where a map is not injective, of what the triangles are there, and
    what to do; None if the map is certified.

    Args:
        name: of the map.
        f: the map, after its repair.
    """
    counts = {key: n for key, n in f.certificate.items() if key != "certified"}
    if f.certificate["certified"]:
        return None
    listed = ", ".join(f"{n} {key.replace('_', ' ')}" for key, n in counts.items() if n)
    said = f"{name}: NOT certified ({listed}). "
    if counts["flipped_triangles"]:
        said += _of_flips(f)
    else:
        said += "Train longer (trainer.max_steps), or give other landmarks"
    return Text(said, style="bold red")


def _of_flips(f: SurfaceMap) -> str:
    """Where flipped triangles are, in the source's file, and what to do about them."""
    s = f.source.surface
    faces = s.faces[flipped(f.image_uv, s.faces)]
    corners = f.source.in_original_units(s.vertices[faces].reshape(-1, 3)).reshape(-1, 3, 3)
    area = face_areas(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    needles = int((2 * area <= _NEEDLE * longest**2).sum())
    at = corners[area.argmax()].mean(axis=0)
    place = ", ".join(f"{x:.6g}" for x in at)
    said = f"Flipped triangles lie around ({place}) of the source. "
    if needles:
        said += (
            f"{needles} of them are thinner than a millionth of their length: merge near vertices "
            "in a mesh editor, or remesh the source"
        )
    if needles == len(faces):
        return said
    advice = "give landmarks, or more steps (trainer.max_steps)"
    if len(f.landmarks):
        marks = f.source.file_mesh()[0][f.landmarks[:, 0]]
        nearest = int(np.linalg.norm(marks - at, axis=1).argmin())
        advice = f"correct or leave out landmark {nearest}, which is nearest to there"
    return f"{said}; otherwise {advice}" if needles else said + advice[0].upper() + advice[1:]
