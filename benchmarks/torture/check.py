"""Checks of the files of a run: are they complete, finite, injective and near the mesh?"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from safetensors.numpy import load_file

import nsm
from nsm.pipeline.folder_lock import LOCK_FILE

# largest RMS distance of φ from the mesh after the few steps of a case, in percent of the diagonal
# Euler characteristics of closed domains
CLOSED = {"orbifold": 2, "torus": 0}
NEAR_PERCENT = 15.0
_ROUNDING = 1e-9
# for maps, whose networks compute in single precision
_SINGLE = 1e-6
# twice an area in Ω: smaller ones are recomputed in rational numbers
_UNSURE = 1e-14


def complaints(folder: Path, task: str, mesh: tuple[np.ndarray, np.ndarray]) -> list[str]:
    """Everything that is wrong in the folder of a finished run."""
    found = [*_files(folder)]
    if not (folder / "metrics.json").exists():
        return [*found, "no metrics.json"]
    surfaces = sorted(folder.rglob("surface.json"))
    if not surfaces:
        return [*found, "no surface.json"]
    for k, file in enumerate(surfaces):
        found += _surface(file.parent, mesh if k == 0 and task != "pair_map" else None)
    if task == "overfit":
        found += _reconstruction(folder)
    else:
        found += _map(folder, task)
    return found


def _files(folder: Path) -> Iterator[str]:
    """Complaints about incomplete files and values that are not finite."""
    for file in sorted(p for p in folder.rglob("*") if p.is_file() and p.name != LOCK_FILE):
        name = file.relative_to(folder)
        if file.suffix == ".tmp" or file.stat().st_size == 0:
            yield f"{name}: incomplete"
            continue
        try:
            arrays = _arrays(file)
        except Exception as error:  # the readers of ten formats raise any exception
            yield f"{name}: unreadable ({type(error).__name__}: {error})"
            continue
        for array in arrays:
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                yield f"{name}: not finite"
                break


def _arrays(file: Path) -> list[np.ndarray]:
    """The numbers in a file."""
    if file.suffix == ".safetensors":
        return list(load_file(file).values())
    if file.suffix == ".json":
        return [np.array(_numbers(json.loads(file.read_text())), dtype=float)]
    if file.suffix in (".obj", ".glb"):
        loaded = trimesh.load(file, process=False, force="mesh")
        uv = getattr(loaded.visual, "uv", None)
        return [np.asarray(loaded.vertices)] + ([] if uv is None else [np.asarray(uv)])
    if file.suffix in (".png", ".gif"):
        with Image.open(file) as picture:
            picture.load()
        return []
    if file.suffix == ".npy":
        return [np.load(file, allow_pickle=False)]
    if file.suffix == ".ckpt":
        return list(_tensors(torch.load(file, weights_only=True, map_location="cpu")))
    return []


def _numbers(content: Any) -> list[float]:
    """All numbers of a JSON file, with null, which stands for NaN, as NaN.

    Settings, which may be null, are left out.
    """
    if isinstance(content, dict):
        return [x for key, value in content.items() if key != "config" for x in _numbers(value)]
    if isinstance(content, list):
        return [x for value in content for x in _numbers(value)]
    if content is None:
        return [math.nan]
    return [float(content)] if isinstance(content, (int, float)) else []


def _tensors(state: Any) -> Iterator[np.ndarray]:
    if isinstance(state, torch.Tensor):
        yield state.detach().numpy()
    elif isinstance(state, dict):
        for value in state.values():
            yield from _tensors(value)
    elif isinstance(state, (list, tuple)):
        for value in state:
            yield from _tensors(value)


def _surface(folder: Path, mesh: tuple[np.ndarray, np.ndarray] | None) -> Iterator[str]:
    """Complaints unless a saved surface is a disc, injective in Ω, with the mesh's vertices."""
    arrays = load_file(folder / "surface.safetensors")
    metadata = json.loads((folder / "surface.json").read_text())
    about, analytic = metadata["surface"], "width" not in metadata["map"]
    faces, uv, vertices = (arrays[f"surface.{key}"] for key in ("faces", "uv", "vertices"))
    area = 4.0 if about["domain"] == "square" else math.pi
    if about["domain"] in CLOSED:
        pairs = arrays["surface.seam_pairs"]
        yield from closed(faces, pairs, about["domain"])
        yield from covering(faces, uv, pairs, about["domain"])
    else:
        yield from disc(faces)
        yield from injective(faces, uv, about["domain"])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    total = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    # triangles inscribed in an analytic surface have a smaller area
    if not math.isclose(total, area, rel_tol=1e-3 if analytic else 1e-6):
        yield f"its area is {total}, not that of the domain"
    if mesh is not None:
        source = arrays["surface.source_vertex"]
        known = source >= 0
        back = vertices[known] / about["scale"] + arrays["surface.center"]
        given = mesh[0][source[known]]
        size = np.abs(mesh[0][np.unique(mesh[1])]).max()
        if np.abs(back - given).max() > 1e-6 * size:
            yield "its vertices are not those of the mesh"


def disc(faces: np.ndarray) -> Iterator[str]:
    """Complaints unless the mesh is an oriented disc: one component, one boundary loop, genus 0."""
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    if len(np.unique(directed, axis=0)) != len(directed):
        yield "two faces use an edge in the same direction"
        return
    edges, count = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    euler = len(np.unique(faces)) - len(edges) + len(faces)
    if euler != 1 or count.max() > 2:
        yield f"Euler characteristic {euler}, not that of a disc"
    if trimesh.graph.connected_component_labels(edges).max() != 0:
        yield "more than one connected component"
    if boundary(faces) is None:
        yield "its boundary is not one loop"


def closed(faces: np.ndarray, pairs: np.ndarray, domain: str) -> Iterator[str]:
    """Complaints unless the mesh with its copies as one is closed, oriented and of Ω's genus."""
    first = np.arange(faces.max() + 1)
    first[pairs[:, 1]] = pairs[:, 0]
    whole = first[faces]
    directed = whole[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = np.unique(directed, axis=0)
    if len(edges) != len(directed) or len(np.unique(np.sort(edges, axis=1), axis=0)) * 2 != len(
        edges
    ):
        yield "it is not closed and oriented"
        return
    euler = len(np.unique(whole)) - len(edges) // 2 + len(whole)
    if euler != CLOSED[domain]:
        yield f"Euler characteristic {euler}, not that of the {domain}"


def covering(faces: np.ndarray, uv: np.ndarray, pairs: np.ndarray, domain: str) -> Iterator[str]:
    """Complaints unless uv maps a closed mesh homeomorphically onto Ω = R²/Γ.

    It does if all triangles are counter-clockwise, their areas add up to that of Ω, and copies of a
    vertex are equal modulo Γ: translations by even integers and, on the orbifold, x ↦ -x.
    """
    folded = _folded(faces, uv)
    if folded:
        yield f"{folded} triangles of the domain are folded"
    total = _double_areas(*(uv[faces[:, k]] for k in range(3))).sum() / 2
    if not math.isclose(total, 2.0 if domain == "orbifold" else 4.0, rel_tol=1e-9):
        yield f"the domain is covered with the area {total}"
    a, b = uv[pairs[:, 0]], uv[pairs[:, 1]]
    off = [np.abs((b - s * a) / 2 - np.rint((b - s * a) / 2)).max(axis=1) for s in (1, -1)]
    apart = off[0] if domain == "torus" else np.minimum(*off)
    if (apart > 1e-9).any():
        yield "copies of a vertex are different points of the domain"


def boundary(faces: np.ndarray) -> np.ndarray | None:
    """The boundary vertices in order; None unless they are one simple loop."""
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key = np.sort(directed, axis=1)
    _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    sides = directed[count[inverse.ravel()] == 1]
    following = dict(sides.tolist())
    if len(following) != len(sides) or not following:
        return None
    start = next(iter(following))
    loop = [start]
    while (vertex := following[loop[-1]]) != start:
        loop.append(vertex)
        if len(loop) > len(sides):
            return None
    return np.array(loop) if len(loop) == len(sides) else None


def injective(
    faces: np.ndarray, uv: np.ndarray, domain: str, rounding: float = _ROUNDING
) -> Iterator[str]:
    """Complaints unless uv maps a disc injectively into Ω.

    It does if all triangles are counter-clockwise and the boundary runs monotonically once around
    ∂Ω, which is convex.
    """
    folded = _folded(faces, uv)
    if folded:
        yield f"{folded} triangles of the domain are folded"
    reach = np.linalg.norm(uv, axis=1) if domain == "disc" else np.abs(uv).max(axis=1)
    if reach.max() > 1 + rounding:
        yield f"a vertex is outside the domain, at {reach.max()}"
    loop = boundary(faces)
    if loop is None:
        return
    if np.abs(reach[loop] - 1).max() > rounding:
        yield "the boundary is not on the boundary of the domain"
    p = uv[loop]
    q = np.roll(p, -1, axis=0)
    turn = np.arctan2(_double_areas(p, q, np.zeros_like(p)), (p * q).sum(axis=1))
    if not (turn > 0).all() or not math.isclose(turn.sum(), 2 * math.pi, rel_tol=1e-9):
        yield "the boundary does not go once around the domain"


def _folded(faces: np.ndarray, uv: np.ndarray) -> int:
    """How many triangles are not counter-clockwise."""
    return int((_double_areas(*(uv[faces[:, k]] for k in range(3))) <= 0).sum())


def _double_areas(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed areas (N,) of triangles abc in Ω, with exact signs."""
    double = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    for k in np.flatnonzero(np.abs(double) < _UNSURE).tolist():
        (x, y), (s, t), (u, v) = ([Fraction(float(z)) for z in p[k]] for p in (a, b, c))
        exact = (s - x) * (v - y) - (t - y) * (u - x)
        # the least positive number represents all smaller ones
        double[k] = float(exact) or math.copysign(5e-324, exact) if exact else 0.0
    return double


def _reconstruction(folder: Path) -> Iterator[str]:
    """Complaints unless the loaded φ is near the mesh."""
    phi = nsm.load(folder)
    arrays = load_file(folder / "surface.safetensors")
    points = phi(arrays["surface.uv"])
    vertices = phi.in_original_units(arrays["surface.vertices"])
    if phi.surface.domain.name in CLOSED:  # written with the vertices of the file
        first, _ = phi.surface.whole()
        points, vertices = points[first], vertices[first]
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    off = 100 * math.sqrt(((points - vertices) ** 2).sum(axis=1).mean()) / diagonal
    if not off < NEAR_PERCENT:
        yield f"φ is {off:.1f} % of the diagonal away from the mesh"
    written = folder / "reconstruction.obj"
    if written.exists():
        again = np.asarray(trimesh.load(written, process=False, maintain_order=True).vertices)
        near = np.array([np.abs(points - vertex).max(axis=1).min() for vertex in again[::97]])
        if near.max() > 1e-2 * diagonal:
            yield "the reconstruction is not φ at the mesh's vertices"


def _map(folder: Path, task: str) -> Iterator[str]:
    """Complaints unless a map onto Ω, loaded and in its OBJ file, is injective as certified."""
    certified = json.loads((folder / "metrics.json").read_text())["certified"]
    source, name = (
        (folder, "parameterized")
        if task == "param"
        else (folder / "source", "source_with_target_uv")
    )
    faces = load_file(source / "surface.safetensors")["surface.faces"]
    domain = json.loads((source / "surface.json").read_text())["surface"]["domain"]
    result = nsm.load(folder)
    image = result.uv if task == "param" else result.image_uv
    if domain in CLOSED:
        pairs = load_file(source / "surface.safetensors")["surface.seam_pairs"]
        found = list(covering(faces, image, pairs, domain))
    else:
        found = list(injective(faces, image, domain, _SINGLE))
    if certified:
        yield from (f"certified, but {complaint}" for complaint in found)
        if domain in CLOSED:  # which have no coordinates in the file
            return
        folded = _folded(faces, _coordinates(folder / f"{name}.obj"))
        if folded:
            yield f"certified, but {folded} triangles of {name}.obj are folded"
    elif not found:
        yield "injective, but not certified"


def _coordinates(file: Path) -> np.ndarray:
    """The texture coordinates (V, 2) of an OBJ, as they are written."""
    lines = (line.split() for line in file.read_text().splitlines())
    return np.array([words[1:] for words in lines if words[:1] == ["vt"]], dtype=float)
