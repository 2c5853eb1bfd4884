"""Correspondences with no landmarks or few against annotated ones, on ordered pairs of shapes.

    python benchmarks/correspondence.py --meshes FOLDER

The error is that of Kim, Lipman and Funkhouser 2011, "Blended intrinsic maps": at the annotated
landmarks of the source, the geodesic distance on the target, along edges, from the image to the
annotated one, over the square root of the area. Landmarks that are given are not counted. Maps are
the coarse ones, before any training on the full meshes, but for the rows with ``full map``.

Rows: ``none``: no landmarks; ``given N``: the N annotated landmarks that are farthest from each
other, completed by proposals; ``..., full map``: the map that the default settings train, which is
what a user gets; ``zoomout``: wave kernel signatures and ZoomOut; ``icp``: the best of 24 rotations
with iterated closest points, then ZoomOut. The last two are pyfmaps' (nsm[peers]), on meshes of
3,000 triangles; without that package they are left out.

Each figure is kept as a line of benchmarks/results/correspondence.jsonl, so that the benchmark goes
on where it stopped; without that file it begins anew. Writes correspondence.json beside it and
docs/pictures/correspondence.png. Seconds are those of the processor, on one thread, from raw
meshes. ``--pairs N`` takes N pairs of the animals only, in an order in which all shapes are sources
and targets equally often.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch
from correspondence_peers import icp_map, zoomout_map
from scipy.spatial import cKDTree

import nsm
from nsm.correspondence import proposed
from nsm.correspondence.distances import edge_distances
from nsm.correspondence.search import Candidate
from nsm.domains.orbifold.common_cones import far_apart
from nsm.domains.orbifold.cover import located
from nsm.surfaces.landmark_files import read_landmarks
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.location import locate
from nsm.surfaces.topology import face_areas
from nsm.surfaces.validation import clean

RESULT = Path(__file__).parent / "results" / "correspondence.json"
LINES = RESULT.with_suffix(".jsonl")
PICTURE = Path(__file__).parents[1] / "docs" / "pictures" / "correspondence.png"
OTHERS = {
    "bust": ("shrec07-302", "shrec07-314"),
    "plane and bird": ("shrec07-61", "shrec07-248"),
    "cat and horse": ("cat_horse-0", "cat_horse-1"),
}
WRONG = 0.15  # a map with a larger mean error
SHARES = (0.05, 0.1, 0.25)
GIVEN = (1, 2, 3, 4, 5, 8)
PEERS = {"zoomout": zoomout_map, "icp": icp_map}


class Annotated(NamedTuple):
    """A mesh, its landmarks (L,), and distances (L, V) from them over the root of the area."""

    vertices: np.ndarray
    faces: np.ndarray
    landmarks: np.ndarray
    distance: np.ndarray

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        return self.vertices, self.faces

    def errors(self, points: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Errors (K,) of points (K, 3) as images of the landmarks numbered ``which`` (K,)."""
        return self.distance[which, cKDTree(self.vertices).query(points)[1]]


def annotated(meshes: Path, name: str) -> Annotated:
    """A mesh of the folder and its landmarks."""
    file = next(file for file in sorted(meshes.glob(f"{name}.*")))
    vertices, faces, _ = load_mesh(file)
    mesh = clean(vertices, faces, name)
    given = read_landmarks(next((meshes / "landmarks").glob(f"{name}.*")))
    landmarks = mesh.merged[np.asarray(given)]
    distance = edge_distances(mesh.vertices, mesh.faces, landmarks)
    root = np.sqrt(face_areas(mesh.vertices, mesh.faces).sum())
    return Annotated(mesh.vertices, mesh.faces, landmarks, distance / root)


def images(found: Candidate, source: Annotated, target: Annotated) -> np.ndarray:
    """Points (L, 3) of the target to which a coarse map takes the source's landmarks."""
    ours, theirs = found.source, found.target
    points = source.vertices[source.landmarks]
    places = locate(points, source.vertices[ours.shape.ids], ours.shape.faces)
    corners = ours.embedding.corners()[places.face]
    image = found.planar(np.einsum("nk,nki->ni", places.weights, corners))
    return located(theirs.embedding, image).take(
        target.vertices[theirs.shape.ids], theirs.shape.faces
    )


Row = Callable[[Annotated, Annotated], dict[str, Any]]


def without(source: Annotated, target: Annotated, given: int = 0) -> dict[str, Any]:
    """No landmarks, or a few that are completed."""
    pick = farthest(source, target, given)
    pairs = np.stack([source.landmarks[pick], target.landmarks[pick]], axis=1)
    proposal = proposed(source.mesh, target.mesh, pairs)
    rest = np.setdiff1d(np.arange(len(source.landmarks)), pick)
    each = [
        target.errors(images(h.candidate, source, target)[rest], rest) for h in proposal.hypotheses
    ]
    return {
        "errors": each[0],
        "best alternative": min(float(e.mean()) for e in each),
        "margin": float(min(proposal.margin, 9.0)),
        "score": float(proposal.hypotheses[0].score),
        "sure": proposal.sure,
    }


def full_map(source: Annotated, target: Annotated, given: int = 0) -> dict[str, Any]:
    """The map that a user gets from both meshes and the landmarks that are given."""
    pick = farthest(source, target, given)
    pairs = np.stack([source.landmarks[pick], target.landmarks[pick]], axis=1)
    with TemporaryDirectory() as folder:
        found = nsm.map_pair(
            source.mesh,
            target.mesh,
            pairs if given else None,
            folder=folder,
            progress=False,
            artefacts=False,
        )
        points = found(source.vertices[source.landmarks])
    rest = np.setdiff1d(np.arange(len(source.landmarks)), pick)
    return {"errors": target.errors(points[rest], rest)}


def farthest(source: Annotated, target: Annotated, count: int) -> np.ndarray:
    """Numbers (count,) of landmarks that are far from each other on both shapes."""
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    shapes = [source, target]
    return far_apart([s.mesh for s in shapes], [s.landmarks for s in shapes], count)[0]


def peer(
    source: Annotated,
    target: Annotated,
    method: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> dict[str, Any]:
    """A method that takes vertices of the source to points of the target."""
    points = method(*source.mesh, *target.mesh, source.landmarks)
    return {"errors": target.errors(points, np.arange(len(points)))}


ROWS: dict[str, Row] = {
    "none": without,
    **{f"given {n}": partial(without, given=n) for n in GIVEN},
    "none, full map": full_map,
    "given 5, full map": partial(full_map, given=5),
    "given 8, full map": partial(full_map, given=8),
    **{name: partial(peer, method=method) for name, method in PEERS.items()},
}


def ordered_pairs(names: list[str]) -> list[tuple[str, str]]:
    """All ordered pairs. Each name is first, and second, once in each further ``len(names)``."""
    n = len(names)
    return [(names[k], names[(k + step) % n]) for step in range(1, n) for k in range(n)]


def measured(row: str, source: Annotated, target: Annotated) -> dict[str, Any]:
    """The figures of one pair."""
    start = time.process_time()
    found = ROWS[row](source, target)
    found["seconds"] = time.process_time() - start
    found["mean"] = float(np.mean(found["errors"]))
    return {key: _rounded(value) for key, value in found.items()}


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4)
    return value.round(4).tolist() if isinstance(value, np.ndarray) else value


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of several pairs, shares of all landmarks of all pairs."""
    every = np.concatenate([np.array(line["errors"]) for line in lines])
    wrong = [line for line in lines if line["mean"] > WRONG]
    found = {
        "pairs": len(lines),
        "mean": round(float(np.mean([line["mean"] for line in lines])), 4),
        **{f"within {s}": round(float((every <= s).mean()), 3) for s in SHARES},
        "wrong": len(wrong),
        "seconds": round(float(np.mean([line["seconds"] for line in lines])), 1),
    }
    if all("sure" in line for line in lines):
        found["best alternative"] = round(
            float(np.mean([line["best alternative"] for line in lines])), 4
        )
        found["sure"] = sum(line["sure"] for line in lines)
        found["wrong and sure"] = sum(line["sure"] for line in wrong)
    return found


def rows_of(lines: list[dict[str, Any]]) -> list[str]:
    """The rows in their order, after those that are kept from earlier versions."""
    found = dict.fromkeys(line["row"] for line in lines)
    return [*(row for row in found if row not in ROWS), *(row for row in ROWS if row in found)]


def draw(lines: list[dict[str, Any]]) -> None:
    """Share of landmarks over error, one curve for each row, of the animals."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 4))
    for row in rows_of(lines):
        chosen = [
            line["errors"] for line in lines if (line["row"], line["kind"]) == (row, "animals")
        ]
        if chosen:
            every = np.sort(np.concatenate([np.array(e) for e in chosen]))
            share = 100 * np.arange(1, len(every) + 1) / len(every)
            style = "--" if "full map" in row else ":" if row in PEERS else "-"
            axes.plot(every, share, style, label=f"{row}, {len(chosen)} pairs")
    axes.set(xlim=(0, 0.3), ylim=(0, 100), xlabel="geodesic error / √area", ylabel="landmarks, %")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=8)
    figure.tight_layout()
    figure.savefig(PICTURE, dpi=120)
    plt.close(figure)


def write(lines: list[dict[str, Any]]) -> None:
    """The JSON of all lines, a summary for each kind and row, and the picture."""
    result: dict[str, Any] = {}
    for row in rows_of(lines):
        for kind in ("animals", *OTHERS):
            chosen = [line for line in lines if (line["row"], line["kind"]) == (row, kind)]
            if chosen:
                result.setdefault(kind, {})[row] = summary(chosen)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    draw(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("meshes"), help="folder of the meshes")
    parser.add_argument("--pairs", type=int, help="so many pairs of the animals; all by default")
    parser.add_argument("--rows", nargs="+", choices=ROWS, help="which rows; all by default")
    given = parser.parse_args()
    rows = list(given.rows or ROWS)
    if find_spec("pyFM") is None and not PEERS.keys().isdisjoint(rows):
        line = f"rows {', '.join(PEERS)} need pyfmaps, which pip install '.[peers]' installs"
        if given.rows:
            parser.exit(2, f"{line}; or take other --rows\n")
        print(f"{line}; they are left out", file=sys.stderr)
        rows = [row for row in rows if row not in PEERS]
    torch.set_num_threads(1)
    animals = sorted(
        file.stem
        for file in (given.meshes / "landmarks").glob("shrec07-*.vts")
        if len(read_landmarks(file)) == 21
    )
    sets = {name: [(a, b), (b, a)] for name, (a, b) in OTHERS.items()}
    sets["animals"] = ordered_pairs(animals)[: given.pairs]
    lines = [json.loads(line) for line in LINES.read_text().splitlines()] if LINES.exists() else []
    done = {(line["row"], line["source"], line["target"]) for line in lines}
    shapes: dict[str, Annotated] = {}
    for row in rows:
        for kind, pairs in sets.items():
            for pair in pairs:
                if (row, *pair) in done:
                    continue
                for name in pair:
                    if name not in shapes:
                        shapes[name] = annotated(given.meshes, name)
                ends = [shapes[name] for name in pair]
                if (
                    row.startswith("given")
                    and len(ends[0].landmarks) <= int(row.split()[1].strip(",")) + 2
                ):
                    continue  # nothing would be left to measure
                line = {"row": row, "kind": kind, "source": pair[0], "target": pair[1]}
                line.update(measured(row, *ends))
                lines.append(line)
                with LINES.open("a") as file:
                    file.write(json.dumps(line) + "\n")
                print({**line, "errors": "..."}, flush=True)
        write(lines)


if __name__ == "__main__":
    main()
