"""A part of a shape that caps close for a map: the part without them, and places on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nsm.surfaces.location import Places

if TYPE_CHECKING:
    from nsm.domains.surface import Surface

_RIM = 1e-8  # weight of a cap's inner vertices: a point with less is on its rim


def without_caps(surface: Surface) -> dict[str, np.ndarray]:
    """The arrays of a surface that change where its caps are left out, by name."""
    assert surface.caps is not None
    kept = surface.of_part
    number = np.full(len(surface.vertices), -1)
    number[kept] = np.arange(len(kept))
    source = surface.source_vertex[kept]
    # a vertex on a boundary may have had its first copy at a cap
    first = np.zeros(len(surface.cut_vertex), dtype=np.int64)
    own = np.flatnonzero(source >= 0)[::-1]
    first[source[own]] = own
    there = first[surface.source_vertex[surface.cut_vertex]]
    pairs = surface.seam_pairs
    return {
        "vertices": surface.vertices[kept],
        "faces": number[surface.faces[~surface.caps]],
        "uv": surface.uv[kept],
        "source_vertex": source,
        "cut_vertex": np.where(surface.cut_vertex >= 0, there, -1),
        "seam_pairs": number[pairs[np.isin(pairs, kept).all(axis=1)]],
    }


def on_caps(surface: Surface, face: np.ndarray) -> np.ndarray:
    """Which of a surface's faces (N,) are those of caps: a mask (N,)."""
    return np.zeros(len(face), dtype=bool) if surface.caps is None else surface.caps[face]


def located_on_part(surface: Surface, points: np.ndarray) -> Places:
    """The nearest places to points (N, 3), in normalised units, on a surface without its caps."""
    near = surface.locator.locate(points)
    if surface.caps is None:
        return near
    return Places(np.flatnonzero(~surface.caps)[near.face], near.weights)


def off_rims(surface: Surface, places: Places) -> Places:
    """Places on a surface, those on the rim of a cap as places on the part."""
    if surface.caps is None:
        return places
    of_caps = np.zeros(len(surface.vertices), dtype=bool)
    of_caps[surface.faces[surface.caps]] = True
    inside = of_caps & (surface.source_vertex < 0)
    share = (places.weights * inside[surface.faces[places.face]]).sum(axis=1)
    rim = np.flatnonzero(surface.caps[places.face] & (share <= _RIM))
    face, weights = places.face.copy(), places.weights.copy()
    if len(rim):
        points = Places(face[rim], weights[rim]).take(surface.vertices, surface.faces)
        face[rim], weights[rim] = located_on_part(surface, points)
    return Places(face, weights)
