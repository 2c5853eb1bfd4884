"""Maps on the disc, settings and seams one by one, and flattenings: one JSON file for each case.

Existing files are kept, so that an interrupted run continues where it stopped; cases that --only
names are measured again:

    python benchmarks/maps.py --meshes FOLDER [--only CASE ...]

Seconds are the CPU time of a map on one thread, from trained surfaces, with its figures and
certificate. closed_maps.py maps many pairs, and a collection, on the disc and without a seam.
"""

from __future__ import annotations

import argparse
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
from nsm.results.render import upright

RESULTS = Path(__file__).parent / "results" / "maps"
ANIMALS = ("shrec07-381", "shrec07-384", "shrec07-388", "shrec07-393")
PICTURES = Path(__file__).parent.parent / "docs" / "pictures"
# the two energies of the paper
ENERGIES = {"isometric": "symmetric_dirichlet", "conformal": "conformal"}
STUDY = ANIMALS[1:3]
UP = "-z"  # of the first of these
DISC = "domain=disc"  # closed_maps.py compares it with domains without a seam
ADAM = "experiment=adam"
# one change from the default at a time, on one pair
VARIANTS = {
    "default": [],
    "landmarks by a fixed weight": ["constraints.landmarks=fixed"],
    "landmarks and seam in full at once": ["constraints.ramp=0"],
    "no term against folds": ["loss_weights.injectivity=0", "loss_weights.triangles=0"],
    "no term on the seam": ["loss_weights.seam=0"],
    "boundary by a penalty": ["constraints.boundary=penalty"],
    "surfaces from a random start": [
        'phi.overrides=["initialization=random","encoding.resolutions=[16,64,256]"]',
    ],
    "Adam alone": [ADAM],
    # of h alone: surfaces and seams are the default's
    "h of the paper, as many steps": [
        "experiment=paper",
        "phi.overrides=[]",
        "seam.path=auto",
        "trainer.max_steps=1500",
    ],
}
SEAMS = {  # seam.path=auto is the default
    "shortest, all landmarks": ["seam.path=shortest"],
    "hidden, all landmarks": ["seam.path=hidden"],
    "shortest, a third": ["seam.path=shortest", "seam.landmarks=7"],
    "hidden, a third": ["seam.path=hidden", "seam.landmarks=7"],
}


def timed(make: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    result = make()
    return result, round(time.process_time() - start, 1)


def mapped(source: str, target: str, landmarks: Any, overrides: list[str]) -> tuple[Any, float]:
    """A map, and its seconds; the meshes become neural surfaces before the clock starts."""

    def run(first: Any, second: Any, marks: Any, settings: list[str]) -> Any:
        return nsm.map_pair(first, second, marks, overrides=settings, progress=False)

    start = run(source, target, landmarks, [*overrides, "trainer.max_steps=1", DISC])
    marks = start.landmarks.tolist() or None
    return timed(lambda: run(start.source, start.target, marks, overrides))


def pair(source: str, target: str, landmarks: Any, overrides: list[str]) -> dict[str, Any]:
    """Figures of a map."""
    f, seconds = mapped(source, target, landmarks, overrides)
    surfaces = {
        phi.surface.name: {
            "rms_percent": phi.metrics.get("rms_percent"),
            "median_symmetric_dirichlet": phi.surface.quality.get("median_symmetric_dirichlet"),
            "log": list(phi.surface.log),
        }
        for phi in (f.source, f.target)
    }
    return {"map_seconds": seconds, "metrics": f.metrics, "surfaces": surfaces}


def study_of(meshes: Path) -> tuple[str, str, list[str]]:
    """The files of the pair that is studied, and of its landmarks."""
    first, second = (str(meshes / f"{name}.off") for name in STUDY)
    return first, second, [str(meshes / "landmarks" / f"{name}.vts") for name in STUDY]


def cases(meshes: Path) -> dict[str, Callable[[], dict[str, Any]]]:
    study = study_of(meshes)
    result: dict[str, Callable[[], dict[str, Any]]] = {
        "igea-sphere_cap": lambda: pair(str(meshes / "igea.ply"), "sphere_cap", None, []),
        "energy: conformal map": lambda: pair(*study, ["energy=conformal"]),
        "energy: conformal map, Adam alone": lambda: pair(*study, [ADAM, "energy=conformal"]),
        "energy: flattening": lambda: by_energy(study[0]),
    }
    for group, variants in (("setting", VARIANTS), ("seam", SEAMS)):
        for name, settings in variants.items():
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
    settings = [] if boundary == "free" else [f"constraints.boundary={boundary}"]
    flat, seconds = timed(lambda: nsm.parameterize(phi, overrides=settings, progress=False))
    few = ["baselines=true", "trainer.max_steps=1"]
    beside = nsm.parameterize(phi, overrides=few, progress=False).metrics
    return {"map_seconds": seconds, "flattening": {**beside, **flat.metrics}}


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
    with upright(UP):
        parameterization_picture(drawn, first.phi.surface, maps)
    with Image.open(drawn) as image:
        small = image.convert("RGB").resize((1200, 1200 * image.height // image.width))
        small.save(PICTURES / "paper-flattening.jpg", quality=85)
    drawn.unlink()
    return found


MAPS_BY_ENERGY = {
    "isometric": "setting: default",
    "isometric, Adam alone": "setting: Adam alone",
    "conformal": "energy: conformal map",
    "conformal, Adam alone": "energy: conformal map, Adam alone",
}
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
    "start_symmetric_dirichlet_median": "median as h starts",
    "start_symmetric_dirichlet_p95": "95th percentile",
    "symmetric_dirichlet_median": "median at the end",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "flipped %",
    "outside_percent": "outside %",
    "landmark_error_max_percent": "landmark error, largest",
    "seam_gap_mean_percent": "seam gap, mean",
    "covered_percent": "covered %",
}
AT_END = {
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_mean": "mean",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "flipped %",
}
FROM_START = {"start_symmetric_dirichlet_median": "median as h starts", **AT_END}
FLAT = {**AT_END, "boundary_self_intersections": "overlaps of the boundary"}


LEAST = "Distortion D_iso is symmetric Dirichlet: 3.98 = 4 - 2ε at best, ε = 0.01."


def tables() -> str:
    """All results as Markdown; a dash is a figure that there is none of."""
    files = sorted(RESULTS.glob("*.json"))
    results = {found["case"]: found for found in (json.loads(f.read_text()) for f in files)}
    changes, flat, energies = [], [], []
    for label, name in MAPS_BY_ENERGY.items():
        if name in results:
            found = results[name]
            if not energies:  # h starts alike, whatever the energy
                energies.append(["map, as h starts", *at_start(found["metrics"], BY_ENERGY), "0"])
            cells = [*values(found["metrics"], BY_ENERGY), f"{found['map_seconds']:.0f}"]
            energies.append([f"map, {label}", *cells])
    for name, found in results.items():
        if name.startswith("param: "):
            flat += _flat_rows(name.removeprefix("param: "), found["flattening"])
        elif "energies" in found:
            for label, figures in found["energies"].items():
                time = f"{figures.get('seconds', 0):.0f}"
                energies.append([f"flattening, {label}", *values(figures, BY_ENERGY), time])
        elif not name.startswith("energy: "):
            cells = [*values(found["metrics"], COLUMNS), f"{found['map_seconds']:.0f}"]
            changes.append([name.replace("igea-", "igea → "), *cells])
    parts = [LEAST]
    parts.append(
        "Maps on the disc, 384 → 388 (cut as a pair): the default, with one setting or the seam "
        "changed at a time, Adam alone, and the paper's h:"
    )
    parts.append(table(["map", *COLUMNS.values(), "seconds"], changes))
    if energies:
        parts.append("By the paper's two energies, flattening 384, and 384 → 388 (cut as a pair):")
        parts.append(table(["what", *BY_ENERGY.values(), "seconds"], energies))
    parts.append("Flattening, beside libigl's methods on the same cut mesh:")
    parts.append(table(["surface", "method", *FLAT.values()], flat))
    return "\n\n".join(parts) + "\n"


def at_start(metrics: dict[str, float], columns: dict[str, str]) -> list[str]:
    """The cells of a map before its optimization, of which nothing is repaired."""
    start = {key.removeprefix("start_"): v for key, v in metrics.items() if key[:6] == "start_"}
    start["flipped_before_repair_percent"] = start["flipped_percent"]
    return values(start, columns)


def _flat_rows(case: str, methods: dict[str, dict[str, float]]) -> list[list[str]]:
    surface, boundary = case.split()
    names = {"nsm": "nsm, free boundary", "domain": "start: domain Ω"}
    if boundary == "fixed":  # the other methods stand there with the free boundary
        methods, names = {"nsm": methods["nsm"]}, {"nsm": "nsm, bijective onto Ω"}
    return [[surface, names.get(m, m), *values(figures, FLAT)] for m, figures in methods.items()]


def values(metrics: dict[str, float], columns: dict[str, str]) -> list[str]:
    """The cells of a table's row."""
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
        if name not in arguments.only if arguments.only else file.exists():
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
