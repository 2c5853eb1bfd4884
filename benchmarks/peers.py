"""Maps beside those of another program, and flattenings beside libigl's SLIM, by the same figures.

    python benchmarks/peers.py --meshes FOLDER [--pairs 384-388 ...] [--flatten shrec07-384.off ...]
        [--command 'PROGRAM {source} {target} {landmarks} {image}' --name NAME]

The command stands for any mapper that takes two meshes and landmarks. The words in braces become
files: two OBJ meshes; pairs of vertices, counted from 0, a line each; and where it has to write the
images of the source's vertices, in their order, on the target: a line "x y z" each, or a mesh file
if the template ends a word with {image}.obj or {image}.off. Without a command, the peer is skipped.

"Surface Maps via Adaptive Triangulations" (Schmidt, Pieper and Kobbelt 2023) comes as a library
with a program for each of its figures. A program for this command reads the meshes and landmarks,
runs the library's default phases, and writes the image of each vertex of the source.

``benchmarks/nearest_points.py`` is such a program, the simplest one.

Seconds are CPU time from files to files. Triangles are turned over whose image on the target is
turned against its normal there, or is no triangle: that is known of any map. Flips are those of the
map of Ω, or of the flattening, with what the network alone flips before repair; only nsm repairs.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import igl
import numpy as np

import nsm
from nsm.results import planar_metrics
from nsm.results.meshes import export_mesh
from nsm.results.pair_metrics import distortion_figures
from nsm.results.surface_map import by_file_vertex
from nsm.surfaces.landmark_files import read_marks
from nsm.surfaces.landmarks import as_vertices
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.topology import face_areas

RESULTS = Path(__file__).parent / "results" / "peers.json"
OURS = {"nsm": [], "nsm, experiment=fast": ["experiment=fast"]}
COLUMNS = {
    "seconds": "seconds",
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "after",
    "turned_percent": "turned over %",
    "landmark_error_mean_percent": "landmarks, mean %",
    "landmark_error_max_percent": "largest %",
}
Mesh = tuple[np.ndarray, np.ndarray]


def figures(
    source: Mesh,
    target: Mesh,
    image: np.ndarray,
    marks: np.ndarray,
    columns: Iterable[str] = tuple(COLUMNS),
) -> dict[str, float]:
    """Figures of a map of meshes, whoever has made it; both are scaled to one area first.

    Args:
        source, target: vertices (V, 3) and faces (F, 3).
        image: (V, 3) points on the target, of the source's vertices; NaN where one has none.
        marks: (L, 2) vertices of source and target.
        columns: the figures to tell.
    """
    (vertices, faces), (other, other_faces) = source, target
    known = np.isfinite(image[faces]).all(axis=(1, 2))
    faces = faces[known]
    scale = np.sqrt(face_areas(vertices, faces).sum() / face_areas(other, other_faces).sum())
    found = distortion_figures(vertices, scale * image, faces)
    normal = np.cross(*(image[faces[:, k]] - image[faces[:, 0]] for k in (1, 2)))
    middle = np.ascontiguousarray(image[faces].mean(axis=1))
    near = igl.point_mesh_squared_distance(middle, np.ascontiguousarray(other), other_faces)[1]
    corner = other[other_faces[near]]
    outwards = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    found["turned_percent"] = 100 * float(((normal * outwards).sum(axis=1) <= 0).mean())
    off = np.linalg.norm(image[marks[:, 0]] - other[marks[:, 1]], axis=1)
    off *= 100 / np.linalg.norm(np.ptp(other, axis=0))
    found["landmark_error_mean_percent"] = float(off.mean())
    found["landmark_error_max_percent"] = float(off.max())
    return {key: found[key] for key in columns if key in found}


def by_command(template: str, source: Mesh, target: Mesh, marks: np.ndarray) -> dict[str, float]:
    """Figures and seconds of the map of another program (see :func:`image_by_command`)."""
    image, seconds = image_by_command(template, source, target, marks)
    return {"seconds": seconds, **figures(source, target, image, marks)}


def image_by_command(
    template: str, source: Mesh, target: Mesh, marks: np.ndarray
) -> tuple[np.ndarray, float]:
    """The images (V, 3) of the source's vertices by another program, and its seconds.

    Raises:
        RuntimeError: it ends with an error, or leaves no image of each vertex.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        files = {name: place / f"{name}.obj" for name in ("source", "target")}
        for file, (vertices, faces) in zip(files.values(), (source, target), strict=True):
            export_mesh(file, vertices, faces, None)
        files |= {"landmarks": place / "landmarks.txt", "image": place / "image"}
        np.savetxt(files["landmarks"], marks, fmt="%d")
        words = [word.format(**files) for word in shlex.split(template)]
        before = _seconds_of_children()
        ended = subprocess.run(words, cwd=folder, capture_output=True, text=True)
        seconds = _seconds_of_children() - before
        if ended.returncode:
            last = (ended.stderr.strip().splitlines() or ["no message"])[-1]
            raise RuntimeError(f"{words[0]} ended with status {ended.returncode}: {last}")
        image = read_image(place)
    if image.shape != source[0].shape:
        raise RuntimeError(f"{words[0]} wrote {image.shape} for {len(source[0])} vertices")
    return image, round(seconds, 1)


def read_image(folder: Path) -> np.ndarray:
    """The points (V, 3) in the file ``image`` of a folder, or in the mesh ``image.obj``.

    Raises:
        RuntimeError: there is none, or it has other than three numbers a line.
    """
    for file in sorted(folder.glob("image*")):
        if file.suffix:
            return load_mesh(file)[0]
        try:
            return np.loadtxt(file, ndmin=2)
        except ValueError as error:
            raise RuntimeError(f"the image is no table of points: {error}") from error
    raise RuntimeError("it wrote no image")


def _seconds_of_children() -> float:
    spent = os.times()
    return spent.children_user + spent.children_system


def by_nsm(
    files: list[Path], marks: np.ndarray, overrides: list[str]
) -> tuple[dict[str, float], dict[str, float]]:
    """The same of nsm's map from raw files, with an empty cache and one thread, and its figures
    as h starts: the parameterizations, composed."""
    before, kept = os.times(), os.environ.get("NSM_CACHE")
    with tempfile.TemporaryDirectory() as cache:
        os.environ["NSM_CACHE"] = cache
        try:
            f = nsm.map_pair(*map(str, files), marks.tolist(), overrides=overrides, progress=False)
        finally:
            os.environ.pop("NSM_CACHE")
            if kept is not None:
                os.environ["NSM_CACHE"] = kept
    after = os.times()
    seconds = sum(after[:4]) - sum(before[:4])
    image = by_file_vertex(f.source.surface, f.target.in_original_units(f.welded_image))
    meshes = [load_mesh(file)[:2] for file in files]
    found = figures(*meshes, image, marks)
    found |= {key: f.metrics[key] for key in ("flipped_before_repair_percent", "flipped_percent")}
    start = {key.removeprefix("start_"): v for key, v in f.metrics.items() if key[:6] == "start_"}
    start["flipped_before_repair_percent"] = start["flipped_percent"]
    return {"seconds": round(seconds, 1), **found}, _chosen(start)


def flattened(file: Path) -> dict[str, dict[str, float]]:
    """Figures of flattening a mesh, cut on the disc: nsm's, and libigl's SLIM on the same cut."""
    from nsm.domains.baselines import free_slim as slim

    phi = nsm.overfit(nsm.Surface.load(file), overrides=["trainer.max_steps=0"], progress=False)
    start = time.process_time()
    flat = nsm.parameterize(phi, progress=False)
    seconds = time.process_time() - start
    surface = phi.surface
    start = time.process_time()
    uv = slim(surface.vertices, surface.faces, surface.uv)
    taken = time.process_time() - start
    beside = planar_metrics(surface.vertices, surface.faces, uv)
    beside["flipped_before_repair_percent"] = beside["flipped_percent"]
    return {
        "nsm": {"seconds": round(seconds, 1), **_chosen(flat.metrics["nsm"])},
        "SLIM (libigl)": {"seconds": round(taken, 1), **_chosen(beside)},
    }


def _chosen(metrics: dict[str, float]) -> dict[str, float]:
    return {key: metrics[key] for key in COLUMNS if key in metrics}


def pair_of(meshes: Path, pair: str) -> tuple[list[Path], np.ndarray]:
    """The files of a pair, and its landmarks as vertices (L, 2)."""
    names = [f"shrec07-{name}" for name in pair.split("-")]
    files = [meshes / f"{name}.off" for name in names]
    marks = []
    for name, file in zip(names, files, strict=True):
        vertices, faces, _ = load_mesh(file)
        given = read_marks(meshes / "landmarks" / f"{name}.vts").landmarks
        marks.append(as_vertices(given, vertices, faces, name).vertex)
    return files, np.stack(marks, axis=1)


def table(results: dict[str, dict[str, Any]]) -> str:
    """The results as Markdown."""
    lines = [f"| shapes | method | {' | '.join(COLUMNS.values())} |"]
    lines.append("|---" * (len(COLUMNS) + 2) + "|")
    for case, ways in results.items():
        shown = case if case.startswith("flattening") else case.replace("-", " → ")
        for way, found in ways.items():
            cells = [f"{found[key]:.3f}" if key in found else "–" for key in COLUMNS]
            lines.append(f"| {shown} | {way} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, required=True)
    parser.add_argument("--pairs", nargs="*", default=["384-388"])
    parser.add_argument("--flatten", nargs="*", default=["shrec07-384.off", "cow.obj"])
    parser.add_argument("--command", help="template of the other program's command")
    parser.add_argument("--name", default="peer", help="of the other program, in the table")
    parser.add_argument("--ways", nargs="*", choices=OURS, default=list(OURS))
    given = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if not given.command:
        print(f"{given.name}: skipped, as there is no --command")
    for pair in given.pairs:
        files, marks = pair_of(given.meshes, pair)
        known = results.setdefault(pair, {})
        for way in given.ways:
            known[way], known[f"{way}, as h starts"] = by_nsm(files, marks, OURS[way])
        if given.command:
            meshes = [load_mesh(file)[:2] for file in files]
            try:
                known[given.name] = by_command(given.command, *meshes, marks)
            except RuntimeError as error:
                print(f"{given.name}, {pair}: {error}")
        _keep(results)
    for name in given.flatten:
        results[f"flattening {Path(name).stem}"] = flattened(given.meshes / name)
        _keep(results)
    print(table(results))


def _keep(results: dict[str, Any]) -> None:
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    RESULTS.with_suffix(".md").write_text(table(results))


if __name__ == "__main__":
    main()
