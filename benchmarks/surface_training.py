"""How much training its neural surfaces' networks need for a map: figures after few and many steps.

    python benchmarks/surface_training.py --meshes FOLDER [--cases CASE ...]

Figures of a map are those of the meshes. CPU seconds, one thread, are those of the surfaces'
trainings, with their least-squares fits. What is in the file is kept.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import nsm

RESULTS = Path(__file__).parent / "results" / "surface_training.json"
STEPS = (1, 250, 1000)
FIGURES = (
    *(f"symmetric_dirichlet_{k}" for k in ("median", "mean", "p95")),
    *(f"start_symmetric_dirichlet_{k}" for k in ("median", "p95")),
    *("flipped_before_repair_percent", "flipped_percent"),
    *("landmark_error_mean_percent", "landmark_error_max_percent", "certified"),
)


def trained(surface: nsm.Surface, steps: int) -> tuple[Any, float]:
    """A neural surface after so many steps, and the seconds that it took."""
    start = time.process_time()
    overrides = [f"trainer.max_steps={steps}"]
    phi = nsm.overfit(surface, overrides=overrides, progress=False)
    return phi, time.process_time() - start


def prepared(meshes: Path, pair: str, settings: list[str]) -> Any:
    """A map that has prepared the surfaces of a pair, hardly trained."""
    if pair == "cat-horse":
        files = [str(meshes / f"cat_horse-{k}.obj") for k in (0, 1)]
        marks = [str(meshes / "landmarks" / f"cat_horse-{k}.txt") for k in (0, 1)]
    else:
        names = [f"shrec07-{name}" for name in pair.split("-")]
        files = [str(meshes / f"{name}.off") for name in names]
        marks = [str(meshes / "landmarks" / f"{name}.vts") for name in names]
    short = ["trainer.max_steps=1", "certification.rounds=0", *settings]
    short.append('phi.overrides=["trainer.max_steps=1"]')
    return nsm.map_pair(*files, marks, overrides=short, progress=False)


def mapped(meshes: Path, case: str, known: dict[str, Any], keep: Callable[[], None]) -> None:
    """Fill in what is not known of a case: a pair, and settings of the map after a space."""
    pair, *settings = case.split()
    ready: Any = None
    for steps in STEPS:
        if str(steps) in known:
            continue
        ready = ready or prepared(meshes, pair, settings)
        ends = [trained(phi.surface, steps) for phi in (ready.source, ready.target)]
        f = nsm.map_pair(
            ends[0][0],
            ends[1][0],
            ready.landmarks.tolist(),
            overrides=settings,
            progress=False,
        )
        known[str(steps)] = {
            "surface_seconds": round(sum(seconds for _, seconds in ends), 1),
            "rms_percent": [round(phi.metrics["rms_percent"], 4) for phi, _ in ends],
            "normal_error_mean_degrees": [
                round(phi.metrics["normal_error_mean_degrees"], 3) for phi, _ in ends
            ],
            **{key: round(float(f.metrics[key]), 4) for key in FIGURES},
        }
        print(case, steps, known[str(steps)], flush=True)
        keep()


def table(known: dict[str, Any]) -> str:
    """The results as Markdown."""
    head = ["map", "steps", "seconds of both surfaces", "RMS", "normals"]
    head += ["median", "95th percentile", "landmarks, mean / largest"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for case, runs in known.items():
        for steps, of in runs.items():
            row = [case.replace("-", " → ", 1), steps, f"{of['surface_seconds']:.0f}"]
            row.append(" / ".join(f"{value:.3f} %" for value in of["rms_percent"]))
            row.append(" / ".join(f"{value:.2f}°" for value in of["normal_error_mean_degrees"]))
            row += [f"{of[f'symmetric_dirichlet_{key}']:.3f}" for key in ("median", "p95")]
            errors = (of[f"landmark_error_{key}_percent"] for key in ("mean", "max"))
            row.append(" / ".join(f"{error:.3f} %" for error in errors))
            lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def section(known: dict[str, Any]) -> list[str]:
    """The results as a section of docs/performance.md."""
    return [
        "",
        "## How much training the surfaces of a map need",
        "",
        "`python benchmarks/surface_training.py --meshes FOLDER`: the same map by "
        "`experiment=fast` from surfaces after their least-squares fit and a number of steps. "
        "Medians and 95th percentiles of symmetric Dirichlet, 3.98 at best, vary without a trend. "
        "Landmarks are met less closely from surfaces that are hardly trained, still within "
        "0.25 % of the diagonal. "
        "Not measured: the default map, and other pairs.",
        "",
        *table(known).splitlines(),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, required=True)
    fast = [f"{pair} experiment=fast" for pair in ("384-388", "381-393", "cat-horse")]
    fast.append("384-388 experiment=fast domain=disc")
    parser.add_argument("--cases", nargs="+", default=[*fast, "384-388"])
    given = parser.parse_args()
    torch.set_num_threads(1)
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for case in given.cases:
        known.setdefault(case, {})
        mapped(
            given.meshes,
            case,
            known[case],
            lambda: RESULTS.write_text(json.dumps(known, indent=1) + "\n") and None,
        )
    print(table(known))


if __name__ == "__main__":
    main()
