"""Pieces cut from shapes, mapped into the whole shape and into others, against the known truth.

    python benchmarks/partial.py --meshes FOLDER

A piece is what lies on one side of a plane across a principal axis of the shape, or in a geodesic
ball around its tip, and has a given share of the area; of several parts, the largest. Where it is
mapped into another shape, it is the side, or what is outside the ball, that has more landmarks.
Meshes have about 5,000 triangles. All maps are those of ``experiment=fast``, on one thread.

- ``itself``: the piece is mapped into the shape that it was cut from, with eight of its vertices as
  landmarks, where the truth is the identity. The error is that of the piece's vertices.
- ``other``: it is mapped into another shape through five annotated landmarks. The error is that of
  the other annotated landmarks on the piece.

Errors are geodesic distances on the target, along edges, from the image to the truth, over the
square root of the target's area. Each case is kept as a line of benchmarks/results/partial.jsonl,
so that the benchmark goes on where it stopped; without that file it begins anew. Writes
partial.json and partial.md beside it, and docs/pictures/partial.png. Seconds are those of the
processor for the map alone: both neural surfaces are made, and cached, before.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

import nsm
from nsm.correspondence.distances import edge_distances
from nsm.domains.orbifold.cones import decimated
from nsm.results.meshes import by_position
from nsm.results.pictures import PANEL, panels, save_figure
from nsm.results.render import View
from nsm.results.textures import GREY
from nsm.surfaces.landmark_files import read_landmarks
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.topology import boundary_loops, face_areas, face_components
from nsm.surfaces.validation import Repairs, clean

RESULT = Path(__file__).parent / "results" / "partial.json"
LINES = RESULT.with_suffix(".jsonl")
PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "partial.png"
FACES = 5000
SETTINGS = ["experiment=fast", "artefacts=false", "trainer.threads=1", "phi.processes=1"]
GIVEN = {"itself": 8, "other": 5}
SHARES = (0.05, 0.1)
SAMPLES = 400
# shape, target, cut and share of the area
CASES = (
    ("cow", "cow", "plane 0", 0.5),
    ("cow", "cow", "ball", 0.67),
    ("homer", "homer", "plane 0", 0.5),
    ("homer", "homer", "ball", 0.33),
    ("shrec07-384", "shrec07-384", "plane 0", 0.6),
    ("shrec07-393", "shrec07-393", "plane 2", 0.5),
    ("shrec07-302", "shrec07-302", "plane 0", 0.5),
    ("shrec07-314", "shrec07-314", "plane 2", 0.67),
    ("shrec07-61", "shrec07-61", "plane 0", 0.6),
    ("shrec07-248", "shrec07-248", "ball", 0.5),
    ("cat_horse-0", "cat_horse-0", "plane 1", 0.5),
    ("shrec07-384", "shrec07-388", "plane 0", 0.67),
    ("shrec07-393", "shrec07-400", "ball", 0.67),
    ("shrec07-302", "shrec07-314", "plane 2", 0.67),
    ("shrec07-314", "shrec07-302", "plane 0", 0.67),
    ("cat_horse-0", "cat_horse-1", "plane 0", 0.67),
    ("cat_horse-1", "cat_horse-0", "ball", 0.67),
)
PICTURED = ("shrec07-384", "shrec07-388")


class Shape(NamedTuple):
    """A mesh, and its annotated landmarks (L,), if it has any."""

    vertices: np.ndarray
    faces: np.ndarray
    landmarks: np.ndarray


def shape(meshes: Path, name: str) -> Shape:
    """A mesh of the folder on fewer triangles, with its landmarks."""
    file = next(file for file in sorted(meshes.glob(f"{name}.*")))
    mesh = clean(*load_mesh(file)[:2], name, Repairs("largest"))
    given = [f for f in (meshes / "landmarks").glob(f"{name}.*") if f.suffix != ".pinned"]
    marks = mesh.merged[np.asarray(read_landmarks(given[0]))] if given else np.zeros(0, np.int64)
    faces, ids = decimated(mesh.vertices, mesh.faces, FACES, marks)
    return Shape(mesh.vertices[ids], faces, np.searchsorted(ids, marks))


Piece = tuple[np.ndarray, np.ndarray, np.ndarray]


def piece(whole: Shape, cut: str, share: float, marked: bool = False) -> Piece:
    """Vertices and faces of a piece, and the vertices of the whole that its own are; with
    ``marked``, the one of both sides that has more landmarks."""
    vertices, faces = whole.vertices, whole.faces
    areas = face_areas(vertices, faces)
    middle = vertices[faces].mean(axis=1)
    if cut == "ball":
        tip = int(
            np.linalg.norm(vertices - np.average(middle, axis=0, weights=areas), axis=1).argmax()
        )
        value = edge_distances(vertices, faces, np.array([tip]))[0][faces].mean(axis=1)
    else:
        centred = middle - np.average(middle, axis=0, weights=areas)
        axes = np.linalg.eigh((centred.T * areas) @ centred)[1][:, ::-1]
        axis = axes[:, int(cut.split()[1])]
        value = centred @ (axis * np.sign(axis[np.abs(axis).argmax()]))
    sides = [_side(whole, areas, v, share) for v in ((value, -value) if marked else (value,))]
    return max(sides, key=lambda side: int(np.isin(whole.landmarks, side[2]).sum()))


def _side(whole: Shape, areas: np.ndarray, value: np.ndarray, share: float) -> Piece:
    """The piece of the faces with the least values (F,)."""
    order = np.argsort(value, kind="stable")
    inside = order[np.cumsum(areas[order]) <= share * areas.sum()]
    label = face_components(whole.faces[inside])
    inside = inside[label == np.bincount(label).argmax()]
    mesh = clean(whole.vertices, whole.faces[inside], "piece", Repairs("largest"))
    assert boundary_loops(mesh.faces), "the piece is the whole"
    return mesh.vertices, mesh.faces, mesh.source_vertex


def far_apart(vertices: np.ndarray, faces: np.ndarray, among: np.ndarray, count: int) -> np.ndarray:
    """Up to ``count`` vertices among some (K,) that are far from each other."""
    distance = edge_distances(vertices, faces, among)[:, among]
    chosen = [int(distance[0].argmax())]
    while len(chosen) < min(count, len(among)):
        chosen.append(int(distance[chosen].min(axis=0).argmax()))
    return among[chosen]


def errors(target: Shape, images: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors (N,) of images (N, 3) whose true places are vertices (N,) of the target."""
    gap, near = cKDTree(target.vertices).query(images)
    away = edge_distances(target.vertices, target.faces, truth)[np.arange(len(truth)), near]
    return (gap + away) / np.sqrt(face_areas(target.vertices, target.faces).sum())


def measured(source: Shape, target: Shape, kind: str, cut: str, share: float) -> dict[str, Any]:
    """The figures of one case, and its map."""
    vertices, faces, number = piece(source, cut, share, kind == "other")
    if kind == "itself":
        given = far_apart(vertices, faces, np.arange(len(vertices)), GIVEN[kind])
        pairs = np.stack([given, number[given]], axis=1)
        asked = np.setdiff1d(np.arange(len(vertices)), given)
        asked = asked[:: max(1, len(asked) // SAMPLES)]
        truth = number[asked]
    else:
        own = np.full(len(source.vertices), -1)
        own[number] = np.arange(len(number))
        here = own[source.landmarks]
        there = np.flatnonzero(here >= 0)
        given = far_apart(vertices, faces, here[there], GIVEN[kind])
        chosen = np.isin(here, given)
        pairs = np.stack([here[chosen], target.landmarks[chosen]], axis=1)
        rest = ~chosen & (here >= 0)
        asked, truth = here[rest], target.landmarks[rest]
    ends = (vertices, faces), (target.vertices, target.faces), pairs.tolist()
    nsm.map_pair(*ends, overrides=[*SETTINGS, "trainer.max_steps=1"], progress=False)
    start = time.process_time()
    f = nsm.map_pair(*ends, overrides=SETTINGS, progress=False)
    seconds = time.process_time() - start
    off = errors(target, f(vertices[asked]), truth)
    return {
        "errors": off.round(4).tolist(),
        "mean": round(float(off.mean()), 4),
        "share": round(float(face_areas(vertices, faces).sum() / _area(source)), 3),
        "loops": len(boundary_loops(faces)),
        "given": len(pairs),
        "median": round(f.metrics["symmetric_dirichlet_median"], 3),
        "p95": round(f.metrics["symmetric_dirichlet_p95"], 2),
        **{
            key: round(f.metrics[key], 4)
            for key in (
                *("start_symmetric_dirichlet_median", "start_symmetric_dirichlet_p95"),
                *("flipped_before_repair_percent", "flipped_percent"),
            )
        },
        "landmarks missed": round(f.metrics["landmark_error_max_percent"], 4),
        "covered": round(f.metrics["covered_percent"], 1),
        "certified": bool(f.certificate["certified"]),
        "seconds": round(seconds, 1),
        "map": f,
    }


def _area(mesh: Shape) -> float:
    return float(face_areas(mesh.vertices, mesh.faces).sum())


def draw(f: Any) -> None:
    """The piece, coloured by position, and the target with its colours."""
    vertices, faces = f.source.file_mesh()
    points, triangles = f.target.file_mesh()
    colours = by_position(vertices)
    carried = f.transfer(colours)
    carried[np.isnan(carried)] = np.broadcast_to(GREY, carried.shape)[np.isnan(carried)]
    drawn = []
    for x, corners, paint, title in (
        (vertices, faces, colours, "a piece"),
        (points, triangles, carried, "its image on another shape"),
    ):
        view = View(x, PANEL)
        picture = view.draw(x, corners, lambda blend, c=paint: blend(c))
        drawn.append((picture, title))
    save_figure(panels(drawn), PICTURE)


def write(lines: list[dict[str, Any]]) -> None:
    """The JSON and the table of all lines."""
    cases = [{k: v for k, v in line.items() if k != "errors"} for line in lines]
    result: dict[str, Any] = {"cases": cases}
    head = (
        "| piece of | share | boundaries | into | landmarks | mean | within 0.05 | within 0.1 | "
        "symmetric Dirichlet as h starts, median | 95th percentile | at the end, median | "
        "95th percentile | flipped % before repair | certified | seconds |"
    )
    rows = [head, "|" + "---|" * 15]
    for line, case in zip(lines, cases, strict=True):
        off = np.array(line["errors"])
        within = [round(float((off <= s).mean()), 3) for s in SHARES]
        case.update({f"within {s}": w for s, w in zip(SHARES, within, strict=True)})
        rows.append(
            f"| {line['source']}, {line['cut']} | {line['share']} | {line['loops']} | "
            f"{line['target']} | {line['given']} | {line['mean']} | {within[0]} | {within[1]} | "
            f"{line['start_symmetric_dirichlet_median']:.2f} | "
            f"{line['start_symmetric_dirichlet_p95']:.2f} | {line['median']} | {line['p95']} | "
            f"{line['flipped_before_repair_percent']:.2f} | "
            f"{'yes' if line['certified'] else 'no'} | {line['seconds']} |"
        )
    for kind in GIVEN:
        some = [line for line in lines if line["kind"] == kind]
        if some:
            result[kind] = {
                "cases": len(some),
                "mean": round(float(np.mean([line["mean"] for line in some])), 4),
                "certified": sum(line["certified"] for line in some),
            }
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    RESULT.with_suffix(".md").write_text("\n".join(rows) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("meshes"), help="folder of the meshes")
    given = parser.parse_args()
    lines = [json.loads(line) for line in LINES.read_text().splitlines()] if LINES.exists() else []
    done = {(line["source"], line["target"], line["cut"]) for line in lines}
    shapes: dict[str, Shape] = {}
    for source, target, cut, share in CASES:
        if (source, target, cut) in done:
            continue
        for name in (source, target):
            if name not in shapes:
                shapes[name] = shape(given.meshes, name)
        kind = "itself" if source == target else "other"
        found = measured(shapes[source], shapes[target], kind, cut, share)
        f = found.pop("map")
        line = {"kind": kind, "source": source, "target": target, "cut": cut, **found}
        lines.append(line)
        with LINES.open("a") as file:
            file.write(json.dumps(line) + "\n")
        print({**line, "errors": "..."}, flush=True)
        if (source, target) == PICTURED:
            draw(f)
        write(lines)
    write(lines)


if __name__ == "__main__":
    main()
