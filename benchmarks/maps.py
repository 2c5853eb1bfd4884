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
from PIL import Image

import nsm
from nsm.results import parameterization_picture

RESULTS = Path(__file__).parent / "results" / "maps"
ANIMALS = ("shrec07-381", "shrec07-384", "shrec07-388", "shrec07-393")
PICTURES = Path(__file__).parent.parent / "docs" / "pictures"
# the two energies of the paper
ENERGIES = {"isometric": "symmetric_dirichlet", "conformal": "conformal"}
STUDY = "shrec07-384", "shrec07-388"
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
    # of h alone: surfaces and seams are the default's
    "paper, as many steps": [
        "experiment=paper",
        "phi.overrides=[]",
        "seam.path=auto",
        "trainer.max_steps=1500",
    ],
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
    study = (*map(animal, STUDY), points(*STUDY))
    result["energy: conformal map"] = lambda: pair(*study, ["energy=conformal"])
    result["energy: flattening"] = lambda: by_energy(animal(STUDY[0]))
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


def by_energy(file: str) -> dict[str, Any]:
    """Figures of flattening by each energy, and the picture of both."""
    words = {label: [f"energy={option}"] for label, option in ENERGIES.items()}
    first = nsm.parameterize(file, overrides=[DISC, "trainer.max_steps=1"], progress=False)
    found: dict[str, Any] = {"map_seconds": 0.0, "energies": {"before": first.metrics["domain"]}}
    maps = {"before: domain Ω": first.phi.surface.uv}
    for label, overrides in words.items():
        flat, seconds = timed(
            lambda overrides=overrides: nsm.parameterize(  # type: ignore[misc]
                first.phi, overrides=overrides, progress=False
            )
        )
        found["energies"][label] = {**flat.metrics["nsm"], "seconds": seconds}
        found["map_seconds"] += seconds
        maps[label] = flat.uv
    drawn = RESULTS / "flattening.png"
    parameterization_picture(drawn, first.phi.surface, maps)
    with Image.open(drawn) as image:
        small = image.convert("RGB").resize((1200, 1200 * image.height // image.width))
        small.save(PICTURES / "paper-flattening.jpg", quality=85)
    drawn.unlink()
    return found


MAPS_BY_ENERGY = {"isometric": "setting: default", "conformal": "energy: conformal map"}
BY_ENERGY = {
    "symmetric_dirichlet_median": "D_iso, median",
    "symmetric_dirichlet_p95": "D_iso, 95th percentile",
    "conformal_median": "D_conf, median",
    "singular_value_ratio_median": "σ₁/σ₂, median",
    "singular_value_ratio_p95": "σ₁/σ₂, 95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "after",
}
COLUMNS = {
    "start_symmetric_dirichlet_median": "median before",
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
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
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "flipped %",
    "boundary_self_intersections": "overlaps of the boundary",
}


def tables() -> str:
    """All results as Markdown; the distortion is symmetric Dirichlet, 3.98 at best.

    Medians before are those of h at its start. A dash is a figure that an older version did not
    measure.
    """
    files = sorted(RESULTS.glob("*.json"))
    results = {found["case"]: found for found in (json.loads(f.read_text()) for f in files)}
    maps, changes, flat, energies = [], [], [], []
    for label, name in MAPS_BY_ENERGY.items():
        if name in results:
            found = results[name]
            cells = [*_values(found["metrics"], BY_ENERGY), f"{found['map_seconds']:.0f}"]
            energies.append([f"map, {label}", *cells])
    for name, found in results.items():
        row = [f"{found['map_seconds']:.0f}"]
        if name.startswith("param: "):
            flat += _flat_rows(name.removeprefix("param: "), found["flattening"])
        elif "energies" in found:
            for label, figures in found["energies"].items():
                time = f"{figures['seconds']:.0f}" if "seconds" in figures else "–"
                energies.append([f"flattening, {label}", *_values(figures, BY_ENERGY), time])
        elif name.startswith("energy: "):
            continue
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
    if energies:
        parts.append("By the paper's two energies, flattening 384 and 384 → 388 (cut as a pair):")
        parts.append(table(["what", *BY_ENERGY.values(), "seconds"], energies))
    others = study(results) + baselines(sorted(RESULTS.parent.glob("published-*.json")))
    if others:
        parts.append("Maps by other means; composed parameterizations are not optimized:")
        parts.append(table(["map", *BASELINES.values(), "seconds"], others))
    parts.append("Flattening, beside libigl's methods on the same cut mesh:")
    parts.append(table(["surface", "method", *FLAT.values()], flat))
    return "\n\n".join(parts) + "\n"


BASELINES = {
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_mean": "mean",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "after",
    "landmark_error_max_percent": "landmark error, largest",
}


def study(results: dict[str, dict[str, Any]]) -> list[list[str]]:
    """The study's pair by default, composed, and by the paper's settings of h, on surfaces and
    seams of the default."""
    rows, pair = [], "384 → 388"
    names = {
        "setting: default": "nsm, default",
        "setting: paper, as many steps": "the paper's settings of h, 1,500 steps",
    }
    for name, label in names.items():
        if name in results:
            found = results[name]
            cells = _values(found["metrics"], BASELINES)
            rows.append([f"{pair}: {label}", *cells, f"{found['map_seconds']:.0f}"])
    start = results.get("energy: conformal map", {}).get("metrics", {})
    if "start_symmetric_dirichlet_median" in start:  # whatever the energy
        rows.append([f"{pair}: its parameterizations composed", *_start(start), "–"])
    return rows


def baselines(files: list[Path]) -> list[list[str]]:
    """Maps of each pair that benchmarks/published.py measured, by the default and by other means.

    A map that is not repaired has one share of flips. The published recipe cuts each shape by
    itself, the default both together.
    """
    rows = []
    for file in files:
        found = json.loads(file.read_text())
        for key, entry in found.items():
            what, _, stage = key.partition("/")
            if " → " not in what:
                continue
            if stage == "default":
                spent = f"{entry['seconds']:.0f}"
                rows.append([f"{what}: nsm, default", *_values(entry["metrics"], BASELINES), spent])
                start = _start(entry["metrics"])
                rows.append([f"{what}: its parameterizations composed", *start, "–"])
                continue
            told = {**entry["metrics"]}
            told["flipped_before_repair_percent"] = told["flipped_percent"]
            label = {
                "before": "parameterizations of the published recipe composed",
                "published": f"{found['form']}, at its stop",
            }.get(stage, f"{found['form']}, after the default's time")
            rows.append([f"{what}: {label}", *_values(told, BASELINES), f"{entry['seconds']:.0f}"])
    return rows


def _start(metrics: dict[str, float]) -> list[str]:
    """The figures of a map before its optimization, of which nothing is repaired."""
    start = {key.removeprefix("start_"): v for key, v in metrics.items() if key[:6] == "start_"}
    start["flipped_before_repair_percent"] = start["flipped_percent"]
    return _values(start, BASELINES)


def _flat_rows(case: str, methods: dict[str, dict[str, float]]) -> list[list[str]]:
    surface, boundary = case.split()
    names = {"nsm": "nsm, free boundary", "domain": "start: domain Ω"}
    if boundary == "fixed":  # the other methods stand there with the free boundary
        methods, names = {"nsm": methods["nsm"]}, {"nsm": "nsm, bijective onto Ω"}
    return [[surface, names.get(m, m), *_values(figures, FLAT)] for m, figures in methods.items()]


def _values(metrics: dict[str, float], columns: dict[str, str]) -> list[str]:
    return [
        f"{metrics[key]:.{2 if key == 'covered_percent' else 3}f}" if key in metrics else "–"
        for key in columns
    ]


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown, without columns in which nothing is measured."""
    kept = [k for k in range(len(head)) if k == 0 or any(row[k] != "–" for row in rows)]
    head, rows = [head[k] for k in kept], [[row[k] for k in kept] for row in rows]
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
