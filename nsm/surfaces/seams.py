"""Seams that a user gives: where a mesh is cut open, and the charts that it falls into."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.cutting import Cut, cut_open, cut_to_disc, seam_pairs
from nsm.surfaces.loading import check_file, error_in
from nsm.surfaces.obj import text_of
from nsm.surfaces.textures import read_uv
from nsm.surfaces.validation import CleanMesh
from nsm.wording import number_of

UV, LINES = "uv", "lines"
_KEY = "seams"
_LARGEST = 100_000_000  # bytes of a file of seams


def read_seams(given: Any, file: str | Path | None, faces: np.ndarray, name: str) -> np.ndarray:
    """The edges (E, 2) of a mesh file along which the mesh is cut.

    Args:
        given: pairs of vertices; a file of them, JSON or text with two numbers a line; ``lines``:
            the ``l`` lines of the OBJ file; ``uv``: the borders of the islands of its texture
            coordinates.
        file: of the mesh, if it has one.
        faces: (G, 3) of the file.
        name: of the mesh, in messages.

    Raises:
        NsmError: ``missing_uv``, ``no_seams``, ``wrong_type``, ``not_an_edge``, or a file that
            cannot be read.
    """
    if isinstance(given, str) and given in (UV, LINES):
        if file is None or not Path(file).is_file():
            reason = f"seams={given} are read from a mesh file; give one, or a list of edges"
            raise NsmError(f"{name}: {reason}", kind="wrong_type", key=_KEY)
        pairs = _marked(Path(file)) if given == LINES else _uv_borders(Path(file), faces)
        if given == LINES and len(pairs) == 0:
            raise error_in(file, "no_seams", "it has no l lines; mark edges, or give other seams")
    else:
        pairs = _pairs(given)
    edges = topology.edges_of(faces).pairs
    base = int(faces.max()) + 1
    known = np.isin(pairs.min(axis=1) * base + pairs.max(axis=1), edges @ [base, 1])
    known &= (pairs >= 0).all(axis=1) & (pairs < base).all(axis=1)
    if not known.all():
        a, b = pairs[int(known.argmin())].tolist()
        raise NsmError(
            f"{name}: {a}-{b} of the seams is no edge of the mesh; give pairs of neighbouring "
            "vertices, counted from 0",
            kind="not_an_edge",
            key=_KEY,
        )
    return pairs


def _pairs(given: Any) -> np.ndarray:
    """Pairs (E, 2) of numbers, given or in a file."""
    what = str(given) if isinstance(given, (str, Path)) else _KEY
    if isinstance(given, (str, Path)):
        file = Path(given)
        check_file(file, _LARGEST)
        try:
            text = text_of(file)
            rows: Any = (
                json.loads(text)
                if text.lstrip().startswith("[")
                else [
                    line.partition("#")[0].replace(",", " ").split()
                    for line in text.splitlines()
                    if line.partition("#")[0].strip()
                ]
            )
            rows = [[int(x) for x in row] for row in rows]
        except (ValueError, TypeError, RecursionError):
            reason = "no edges: give two vertex numbers on each line, or a JSON list of pairs"
            raise error_in(file, "damaged_file", reason) from None
    else:
        rows = given.tolist() if hasattr(given, "tolist") else given
    try:
        pairs = np.array(rows, dtype=np.float64).reshape(len(rows), 2)
        if not (pairs == np.rint(pairs)).all():
            raise ValueError
    except (TypeError, ValueError):
        reason = "give pairs of vertex numbers, uv, lines or a file"
        raise error_in(what, "wrong_type", reason) from None
    return pairs.astype(np.int64)


def _marked(file: Path) -> np.ndarray:
    """The edges (E, 2) of the ``l`` lines of an OBJ file, which count vertices from 1."""
    check_file(file, _LARGEST, (".obj",))
    pairs, count = [], 0
    for line in text_of(file).splitlines():
        fields = line.partition("#")[0].split()
        count += fields[:1] == ["v"]
        if fields[:1] == ["l"]:
            try:
                numbers = [int(field.partition("/")[0]) for field in fields[1:]]
            except ValueError:
                reason = f"not a line of vertices: {line.strip()[:40]!r}"
                raise error_in(file, "damaged_file", reason) from None
            chain = [n - 1 if n > 0 else count + n for n in numbers]
            pairs += list(zip(chain[:-1], chain[1:], strict=True))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _uv_borders(file: Path, faces: np.ndarray) -> np.ndarray:
    uv = read_uv(file)
    if uv is None:
        reason = "not every face has texture coordinates; unwrap it in an editor, or give edges"
        raise error_in(file, "missing_uv", reason)
    return uv_seams(faces, uv)


def uv_seams(faces: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Inner edges (E, 2) of faces (F, 3) whose corner values (F, 3, 2) differ across them."""
    pairs = topology.adjacent_faces(topology.edges_of(faces))
    face, corner = pairs // 3, pairs % 3
    following = (corner + 1) % 3
    (f, g), (i, j), (k, m) = face.T, corner.T, following.T
    turned = faces[f, i] == faces[g, m]  # neighbours run along an edge in opposite directions
    there = np.where(turned[:, None], uv[g, m], uv[g, j])
    beyond = np.where(turned[:, None], uv[g, j], uv[g, m])
    differ = (uv[f, i] != there).any(axis=1) | (uv[f, k] != beyond).any(axis=1)
    return np.stack([faces[f, i], faces[f, k]], axis=1)[differ]


def kept_edges(pairs: np.ndarray, mesh: CleanMesh) -> np.ndarray:
    """Edges (E, 2) of a mesh file as those of its cleaned mesh, without removed ones."""
    merged = mesh.merged[pairs]
    return merged[(merged >= 0).all(axis=1) & (merged[:, 0] != merged[:, 1])]


def charts(mesh: CleanMesh, pairs: np.ndarray, name: str) -> list[Cut]:
    """The discs into which a mesh falls along edges, those with most faces first.

    A part that is no disc yet is cut further, as :func:`nsm.surfaces.cutting.cut_to_disc` does.

    Args:
        mesh: the mesh.
        pairs: (E, 2) vertices of edges of it.
        name: of the mesh, in messages.

    Returns:
        Cuts of the mesh; each has the vertices of its part alone.
    """
    edges = topology.edges_of(mesh.faces)
    base = len(mesh.vertices)
    wanted = np.sort(pairs, axis=1) @ [base, 1]
    faces, old = topology.cut_along(mesh.faces, np.isin(edges.pairs @ [base, 1], wanted))
    label = topology.face_components(faces)
    parts = []
    for k in np.argsort(-np.bincount(label), kind="stable").tolist():
        used, number = topology.renumbered(faces[label == k], len(old))
        own, points = number[faces[label == k]], mesh.vertices[old[used]]
        if topology.is_disc(own):
            log = [f"cut along {number_of(len(wanted), 'given edge')}"]
            parts.append(_of_whole(cut_open(points, own, [], log, name), old[used]))
        else:
            parts.append(_of_whole(cut_to_disc(points, own, name=name), old[used]))
    return parts


def _of_whole(cut: Cut, origin: np.ndarray) -> Cut:
    """A part's cut with the whole mesh's vertices (V,) as the origin of its own."""
    of_whole = np.where(cut.origin >= 0, origin[cut.origin], -1)
    return Cut(cut.vertices, cut.faces, of_whole, seam_pairs(of_whole), cut.loop, cut.log)


def count_of(parts: Sequence[Cut]) -> str:
    """How many charts there are, in words."""
    return f"{len(parts)} charts of {', '.join(str(len(p.faces)) for p in parts[:8])} faces"
