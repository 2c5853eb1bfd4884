"""Correspondences without landmarks against annotated ones, on ordered pairs of shapes.

    python benchmarks/correspondence.py --meshes FOLDER

The error is that of Kim, Lipman and Funkhouser 2011, "Blended intrinsic maps": at the annotated
landmarks of the source, the geodesic distance on the target, along edges, from the image to the
annotated one, over the square root of the area. Writes benchmarks/results/correspondence.json;
seconds are those of the processor, on one thread, from raw meshes. ``--every N`` takes each N-th
pair of the animals only.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from nsm.correspondence import Hypothesis, proposed
from nsm.correspondence.coarse_shape import edge_distances
from nsm.domains.orbifold.cover import located
from nsm.surfaces.landmark_files import read_landmarks
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.location import locate
from nsm.surfaces.topology import face_areas
from nsm.surfaces.validation import clean

RESULT = Path(__file__).parent / "results" / "correspondence.json"
OTHERS = {
    "bust": ("shrec07-302", "shrec07-314"),
    "plane and bird": ("shrec07-61", "shrec07-248"),
    "cat and horse": ("cat_horse-0", "cat_horse-1"),
}
WRONG = 0.15  # a map with a larger mean error
SHARES = (0.05, 0.1, 0.25)


class Annotated(NamedTuple):
    """A mesh, its landmarks (L,), and distances (L, V) from them over the root of the area."""

    vertices: np.ndarray
    faces: np.ndarray
    landmarks: np.ndarray
    distance: np.ndarray


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


def errors(hypothesis: Hypothesis, source: Annotated, target: Annotated) -> np.ndarray:
    """The errors (L,) of a hypothesis's coarse map."""
    found = hypothesis.candidate
    ours, theirs = found.source, found.target
    points = source.vertices[source.landmarks]
    places = locate(points, source.vertices[ours.shape.ids], ours.shape.faces)
    corners = ours.embedding.corners()[places.face]
    image = found.planar(np.einsum("nk,nki->ni", places.weights, corners))
    at = located(theirs.embedding, image).take(
        target.vertices[theirs.shape.ids], theirs.shape.faces
    )
    nearest = cKDTree(target.vertices).query(at)[1]
    return target.distance[np.arange(len(nearest)), nearest]


def measured(source: Annotated, target: Annotated) -> dict[str, Any]:
    """The figures of one pair."""
    start = time.process_time()
    proposal = proposed((source.vertices, source.faces), (target.vertices, target.faces))
    seconds = time.process_time() - start
    each = [errors(h, source, target) for h in proposal.hypotheses]
    return {
        "errors": each[0].round(4).tolist(),
        "mean": round(float(each[0].mean()), 4),
        "best alternative": round(min(float(e.mean()) for e in each), 4),
        "margin": round(min(proposal.margin, 9.0), 3),
        "score": round(proposal.hypotheses[0].score, 3),
        "sure": proposal.sure,
        "seconds": round(seconds, 1),
    }


def summary(pairs: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The figures of several pairs, mean over all landmarks of all pairs."""
    every = np.concatenate([np.array(p["errors"]) for p in pairs.values()])
    wrong = [p for p in pairs.values() if p["mean"] > WRONG]
    return {
        "pairs": len(pairs),
        "mean": round(float(np.mean([p["mean"] for p in pairs.values()])), 4),
        "best alternative": round(
            float(np.mean([p["best alternative"] for p in pairs.values()])), 4
        ),
        **{f"within {s}": round(float((every <= s).mean()), 3) for s in SHARES},
        "wrong": len(wrong),
        "sure": sum(p["sure"] for p in pairs.values()),
        "wrong and sure": sum(p["sure"] for p in wrong),
        "seconds": round(float(np.mean([p["seconds"] for p in pairs.values()])), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("meshes"), help="folder of the meshes")
    parser.add_argument("--every", type=int, default=1, help="each N-th pair of the animals")
    given = parser.parse_args()
    torch.set_num_threads(1)
    animals = sorted(
        file.stem
        for file in (given.meshes / "landmarks").glob("shrec07-*.vts")
        if len(read_landmarks(file)) == 21
    )
    sets = {"animals": [(a, b) for a in animals for b in animals if a != b][:: given.every]}
    sets.update({name: [(a, b), (b, a)] for name, (a, b) in OTHERS.items()})
    shapes: dict[str, Annotated] = {}
    results: dict[str, Any] = {}
    for kind, pairs in sets.items():
        figures = {}
        for pair in pairs:
            for name in pair:
                if name not in shapes:
                    shapes[name] = annotated(given.meshes, name)
            figures[" ".join(pair)] = measured(shapes[pair[0]], shapes[pair[1]])
            print(kind, *pair, {**figures[" ".join(pair)], "errors": "..."}, flush=True)
        results[kind] = {"all": summary(figures), "pairs": figures}
        print(kind, results[kind]["all"], flush=True)
        RESULT.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
