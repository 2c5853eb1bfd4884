"""Maps between classic meshes: quality and time, one JSON file for each case.

Existing files are kept, so that an interrupted run continues where it stopped:

    python benchmarks/maps.py --meshes FOLDER [--only CASE ...]

Seconds are the CPU time of a map on one thread, from trained surfaces, with its figures and
certificate.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import nsm

RESULTS = Path(__file__).parent / "results" / "maps"
ANIMALS = ("shrec07-381", "shrec07-384", "shrec07-388", "shrec07-393")
DISC = "domain=disc"  # closed_maps.py compares it with domains without a seam
# one change from the default at a time, on one pair
VARIANTS = {
    "default": [],
    "landmarks by a fixed weight": ["constraints.landmarks=fixed"],
    "landmarks and seam in full at once": ["constraints.ramp=0"],
    "no term on triangles": ["loss_weights.triangles=0"],
    "no term on the seam": ["loss_weights.seam=0"],
    "boundary by a penalty": ["constraints.boundary=penalty"],
    "surfaces from a random start": [
        'phi.overrides=["initialization=random","encoding.resolutions=[16,64,256]"]'
    ],
    "paper, as many steps": ["experiment=paper", "trainer.max_steps=1500"],
}
SEAMS = {
    "auto": [],
    "shortest, all landmarks": ["seam.path=shortest"],
    "hidden, all landmarks": ["seam.path=hidden"],
    "shortest, a third": ["seam.path=shortest", "seam.landmarks=7"],
    "hidden, a third": ["seam.path=hidden", "seam.landmarks=7"],
}


def timed(make: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    result = make()
    return result, round(time.process_time() - start, 1)


def pair(source: Any, target: Any, landmarks: Any, overrides: list[str]) -> dict[str, Any]:
    """Figures of a map; raw meshes become neural surfaces before the clock starts."""

    def run(settings: list[str]) -> Any:
        return nsm.map_pair(source, target, landmarks, overrides=settings, progress=False)

    if isinstance(source, str):
        f = run([*overrides, "trainer.max_steps=1", DISC])  # fills the cache
        source, target = f.source, f.target
        landmarks = f.landmarks.tolist() or None
    f, seconds = timed(lambda: run(overrides))
    surfaces = {
        phi.surface.name: {
            "rms_percent": phi.metrics.get("rms_percent"),
            "median_symmetric_dirichlet": phi.surface.quality.get("median_symmetric_dirichlet"),
            "log": list(phi.surface.log),
        }
        for phi in (f.source, f.target)
    }
    return {"map_seconds": seconds, "metrics": f.metrics, "surfaces": surfaces}


def cases(meshes: Path) -> dict[str, Callable[[], dict[str, Any]]]:
    marks = meshes / "landmarks"

    def animal(name: str) -> str:
        return str(meshes / f"{name}.off")

    def points(*names: str) -> list[str]:
        return [str(marks / f"{name}.vts") for name in names]

    cat, horse = (str(meshes / f"cat_horse-{k}.obj") for k in (0, 1))
    both = [str(marks / f"cat_horse-{k}.txt") for k in (0, 1)]

    def collection() -> dict[str, Any]:
        files = [animal(name) for name in ANIMALS]
        nsm.map_collection(files, points(*ANIMALS), overrides=["trainer.max_steps=1", DISC])
        group, seconds = timed(
            lambda: nsm.map_collection(files, points(*ANIMALS), overrides=[DISC], progress=False)
        )
        return {"map_seconds": seconds, "metrics": group.metrics}

    def ordered(i: int, j: int) -> dict[str, Any]:
        # prepared jointly, as in the collection: the surfaces come from the cache
        files = [animal(name) for name in ANIMALS]
        group = nsm.map_collection(
            files, points(*ANIMALS), overrides=["trainer.max_steps=1", DISC], progress=False
        )
        a, b = group.surfaces[i], group.surfaces[j]
        return pair(a, b, group.landmarks[:, [i, j]].tolist(), [])

    result: dict[str, Callable[[], dict[str, Any]]] = {
        "cat-horse": lambda: pair(cat, horse, both, []),
        "horse-cat": lambda: pair(horse, cat, both[::-1], []),
        "collection": collection,
    }
    for i, j in itertools.permutations(range(len(ANIMALS)), 2):
        result[f"{ANIMALS[i][-3:]}-{ANIMALS[j][-3:]}"] = lambda i=i, j=j: ordered(i, j)  # type: ignore[misc]
    result["igea-sphere_cap"] = lambda: pair(str(meshes / "igea.ply"), "sphere_cap", None, [])
    study = (animal("shrec07-384"), animal("shrec07-388"), points("shrec07-384", "shrec07-388"))
    for group, variants in (("setting", VARIANTS), ("seam", SEAMS)):
        for name, settings in variants.items():
            if settings or group == "setting":
                key = f"{group}: {name}"
                result[key] = lambda settings=settings: pair(*study, settings)  # type: ignore[misc]
    for name in ("shrec07-384.off", "cow.obj"):
        for kind in ("free", "fixed"):
            file = str(meshes / name)
            result[f"param: {name.split('.')[0]} {kind}"] = (  # type: ignore[misc]
                lambda file=file, kind=kind: flattened(file, kind)
            )
    return result


def flattened(file: str, boundary: str) -> dict[str, Any]:
    """Figures of flattening, with those of libigl's methods on the same cut mesh."""
    phi = nsm.overfit(nsm.Surface.load(file), progress=False)
    settings = [f"constraints.boundary={boundary}"]
    flat, seconds = timed(lambda: nsm.parameterize(phi, overrides=settings, progress=False))
    return {"map_seconds": seconds, "flattening": flat.metrics}


COLUMNS = {
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_percent": "flipped %",
    "outside_percent": "outside %",
    "landmark_error_max_percent": "landmark error, largest",
    "seam_gap_mean_percent": "seam gap, mean",
    "covered_percent": "covered %",
}
FLAT = {
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_mean": "mean",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_percent": "flipped %",
    "boundary_self_intersections": "overlaps of the boundary",
}


def tables() -> str:
    """All results as Markdown; the distortion is symmetric Dirichlet, 4 at best."""
    files = sorted(RESULTS.glob("*.json"))
    results = {found["case"]: found for found in (json.loads(f.read_text()) for f in files)}
    maps, changes, flat = [], [], []
    for name, found in results.items():
        row = [f"{found['map_seconds']:.0f}"]
        if name.startswith("param: "):
            flat += _flat_rows(name.removeprefix("param: "), found["flattening"])
        elif name.startswith(("setting: ", "seam: ")):
            changes.append([name, *_values(found["metrics"], COLUMNS), *row])
        elif "pairs" not in found["metrics"]:
            maps.append([name.replace("-", " → "), *_values(found["metrics"], COLUMNS), *row])
    parts = [table(["map", *COLUMNS.values(), "seconds"], maps)]
    if "collection" in results:
        found = results["collection"]
        rows = [
            [pair.replace("shrec07-", ""), *_values(metrics, COLUMNS)]
            for pair, metrics in found["metrics"]["pairs"].items()
        ]
        mean, most = (found["metrics"][f"cycle_error_{k}_percent"] for k in ("mean", "max"))
        parts.append(
            "The collection of the four animals, all ordered pairs by one training of "
            f"{found['map_seconds']:.0f} s; cycle error\n{mean:.3f} % of the diagonal in the mean, "
            f"{most:.2f} % at most:"
        )
        parts.append(table(["pair", *COLUMNS.values()], rows))
    parts.append("One setting changed at a time, on 384 → 388 (cut as a pair):")
    parts.append(table(["change", *COLUMNS.values(), "seconds"], changes))
    parts.append("Flattening, beside libigl's methods on the same cut mesh:")
    parts.append(table(["surface", "method", *FLAT.values()], flat))
    return "\n\n".join(parts) + "\n"


def _flat_rows(case: str, methods: dict[str, dict[str, float]]) -> list[list[str]]:
    surface, boundary = case.split()
    names = {"nsm": "nsm, free boundary", "domain": "start: domain Ω"}
    if boundary == "fixed":  # the other methods stand there with the free boundary
        methods, names = {"nsm": methods["nsm"]}, {"nsm": "nsm, bijective onto Ω"}
    return [[surface, names.get(m, m), *_values(figures, FLAT)] for m, figures in methods.items()]


def _values(metrics: dict[str, float], columns: dict[str, str]) -> list[str]:
    return [f"{metrics[key]:.{2 if key == 'covered_percent' else 3}f}" for key in columns]


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    parser.add_argument("--only", nargs="*", help="cases to run; all by default")
    arguments = parser.parse_args()
    if not arguments.meshes.is_dir():
        parser.error(f"{arguments.meshes}: no such folder; give one with --meshes")
    RESULTS.mkdir(parents=True, exist_ok=True)
    for name, run in cases(arguments.meshes).items():
        file = RESULTS / f"{name.replace(': ', '-').replace(', ', '-').replace(' ', '_')}.json"
        if file.exists() or (arguments.only and name not in arguments.only):
            continue
        print(name, flush=True)
        found = {
            "case": name,
            "torch": torch.__version__,
            "machine": platform.machine(),
            **run(),
        }
        file.write_text(json.dumps(found, indent=2) + "\n")
    text = tables()
    (RESULTS.parent / "maps.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
