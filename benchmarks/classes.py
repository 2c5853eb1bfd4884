"""Maps between two poses of classes of shapes made by formula, as a user would run them.

    python benchmarks/classes.py [--only NAME ...] [--rows ROW ...]

Each case is a command of its own with the default settings, an empty cache and one thread, from raw
files; seconds are those of the processor until the map and its figures are written, without
pictures. Errors are those of landmarks that were not given: the geodesic distance on the target,
along edges, from the image to the known place, over the square root of the target's area. Of a
shape with rotations to itself that keep given landmarks, they are the least over these. A map is
wrong if its mean error is above 0.15, and told if a warning goes with it: that proposed landmarks
are not sure, that landmarks are doubtful, or that the map is much distorted or torn.

Rows: ``given``: six to nine landmarks; ``two``: the two of them that are farthest apart; ``none``;
``flat``: the flattening of the first pose. Each case is kept as a line of
benchmarks/results/classes.jsonl, so that the benchmark goes on where it stopped; without that file
it begins anew. Writes classes.json and classes.md beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from formula_shapes import NAMES, Shape, made, symmetries
from maps import FROM_START, table
from scipy.spatial import cKDTree

from nsm.correspondence.distances import edge_distances
from nsm.results import load_surface_map
from nsm.surfaces.topology import face_areas

RESULT = Path(__file__).parent / "results" / "classes.json"
LINES = RESULT.with_suffix(".jsonl")
ROWS = ("given", "two", "none", "flat")
SETTINGS = ["artefacts=false", "logger=none", "trainer.threads=1", "phi.processes=1"]
WRONG = 0.15
LIMIT = 600  # seconds of a command
COLUMNS = {
    "given": "landmarks",
    **FROM_START,
    "landmark_error_max_percent": "landmarks missed, %",
    "seam_gap_max_percent": "seam gap, largest",
    "certified": "certified",
    "error": "error",
    "told": "told",
    "seconds": "seconds",
}


def command(words: list[str], folder: Path) -> dict[str, Any]:
    """How a run of ``nsm`` in a folder ended, what it said, and its seconds of the processor."""
    environment = {**os.environ, "NSM_CACHE": str(folder / "cache"), "OMP_NUM_THREADS": "1"}
    before = os.times()
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "nsm.cli", *words, *SETTINGS, f"hydra.run.dir={folder}/run"],
            cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT,
        )  # fmt: skip
        status, said = ended.returncode, ended.stdout + ended.stderr
    except subprocess.TimeoutExpired as late:
        status, said = -1, str(late)
    after = os.times()
    spent = after.children_user + after.children_system
    spent -= before.children_user + before.children_system
    found: dict[str, Any] = {"status": status, "seconds": round(spent, 1)}
    if status:
        found["said"] = said[-600:]
    if "Traceback" in said:
        found["crashed"] = True
    return found


def far_pair(shape: Shape) -> np.ndarray:
    """The two of the landmarks that may be given that are farthest apart."""
    marks = shape.landmarks[: shape.given]
    apart = edge_distances(shape.vertices, shape.faces, marks)[:, marks]
    return np.array(np.unravel_index(apart.argmax(), apart.shape))


def errors(
    f: Any, source: Shape, target: Shape, known: np.ndarray, orders: Sequence[np.ndarray]
) -> np.ndarray:
    """Errors (K,) at the landmarks that were not given: the least in the mean over the orders (L,)
    in which the target's landmarks correspond to the source's, the given ones to themselves."""
    rest = np.setdiff1d(np.arange(len(source.landmarks)), known)
    images = f(source.vertices[source.landmarks[rest]])
    gap, near = cKDTree(target.vertices).query(images)
    away = edge_distances(target.vertices, target.faces, target.landmarks)[:, near]
    root = np.sqrt(face_areas(target.vertices, target.faces).sum())
    found = [
        (gap + away[order[rest], np.arange(len(rest))]) / root
        for order in orders
        if np.array_equal(order[known], known)
    ]
    return min(found, key=np.mean)


def measured(name: str, row: str) -> dict[str, Any]:
    """The figures of one case."""
    source, target = made(name, 0), made(name, 1)
    known = {"given": np.arange(source.given), "two": far_pair(source)}.get(row, np.zeros(0, int))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for end, shape in (("a", source), ("b", target)):
            mesh = trimesh.Trimesh(shape.vertices, shape.faces, process=False)
            mesh.export(folder / f"{end}.off")
            (folder / f"{end}.json").write_text(json.dumps(shape.landmarks[known].tolist()))
        words = ["param", "a.off"] if row == "flat" else ["pair_map", "a.off", "b.off"]
        words += ["landmarks=[a.json,b.json]"] if len(known) else []
        found = command(words, folder)
        if found["status"]:
            return found
        report = json.loads((folder / "run" / "metrics.json").read_text())
        figures = report["metrics"]
        figures = figures.get("nsm", figures)
        found.update({k: figures[k] for k in COLUMNS if k in figures})
        found.update(given=len(known), certified=report.get("certified"))
        found["warnings"] = report.get("warnings", [])
        if row != "flat":
            off = errors(load_surface_map(folder / "run"), source, target, known, symmetries(name))
            doubt = not figures.get("landmarks_sure", True) or figures.get("landmarks_doubtful")
            found.update(error=float(off.mean()), errors=off.round(4).tolist())
            found.update(told=bool(doubt or found["warnings"]), wrong=bool(off.mean() > WRONG))
    return {k: round(v, 4) if isinstance(v, float) else v for k, v in found.items()}


def shown(line: dict[str, Any], key: str) -> str:
    """A cell of the table."""
    value = line.get(key)
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3f}" if isinstance(value, float) and key != "seconds" else str(value)


def write(lines: list[dict[str, Any]]) -> None:
    """The JSON and the table of all lines."""
    maps = [line for line in lines if line["row"] != "flat"]
    summary = {
        "cases": len(lines),
        "ended": sum(not line["status"] for line in lines),
        "crashed": sum(bool(line.get("crashed")) for line in lines),
        "certified": sum(bool(line.get("certified")) for line in lines),
        "wrong": sum(bool(line.get("wrong")) for line in maps),
        "wrong and not told": sum(
            bool(line.get("wrong") and not line.get("told")) for line in maps
        ),
        "seconds, most": max(line["seconds"] for line in lines),
    }
    RESULT.write_text(json.dumps({"summary": summary, "cases": lines}, indent=1) + "\n")
    rows = []
    order = {(n, r): k for k, (n, r) in enumerate((n, r) for r in ROWS for n in NAMES)}
    for line in sorted(lines, key=lambda one: order[one["class"], one["row"]]):
        rows.append([line["class"], line["row"], *(shown(line, key) for key in COLUMNS)])
    every = table(["class", "row", *COLUMNS.values()], rows)
    RESULT.with_suffix(".md").write_text(f"{every}\n\n{by_class(lines)}\n")
    print(json.dumps(summary))


def by_class(lines: list[dict[str, Any]]) -> str:
    """The table of docs/maps.md: each class with many landmarks, and with none."""
    heads = [
        *("class", "landmarks", "median as h starts", "median", "95th percentile"),
        *("flipped % before repair", "landmarks missed, %", "certified", "error"),
        *("error, none given", "told as unsure", "seconds, given and none"),
    ]
    rows = []
    of = {(line["class"], line["row"]): line for line in lines}
    digits = {
        "start_symmetric_dirichlet_median": 2,
        "symmetric_dirichlet_median": 2,
        "symmetric_dirichlet_p95": 1,
        "flipped_before_repair_percent": 2,
        "landmark_error_max_percent": 3,
    }
    for name in NAMES:
        given, none = of.get((name, "given")), of.get((name, "none"), {})
        if given is None:
            continue
        figures = [f"{given[key]:.{places}f}" for key, places in digits.items()]
        alone = [shown(none, key) for key in ("error", "told")]
        seconds = f"{shown(given, 'seconds')}, {shown(none, 'seconds')}"
        certified, error = shown(given, "certified"), shown(given, "error")
        rows.append([name, str(given["given"]), *figures, certified, error, *alone, seconds])
    return table(heads, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=NAMES, default=list(NAMES), help="classes")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), help="rows")
    given = parser.parse_args()
    lines = [json.loads(line) for line in LINES.read_text().splitlines()] if LINES.exists() else []
    done = {(line["class"], line["row"]) for line in lines}
    for row in given.rows:
        for name in given.only:
            if (name, row) in done:
                continue
            line = {"class": name, "row": row, **measured(name, row)}
            lines.append(line)
            with LINES.open("a") as file:
                file.write(json.dumps(line) + "\n")
            print({k: v for k, v in line.items() if k != "errors"}, flush=True)
    write(lines)


if __name__ == "__main__":
    main()
