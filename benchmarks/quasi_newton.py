"""Maps by quasi-Newton steps beside the default, from ready surfaces.

    python benchmarks/quasi_newton.py --meshes FOLDER [--pairs 384-388 "381-393 disc" ...]

Seconds are the CPU time of a map on one thread, with its certificate and figures; all ways of a
pair run in turn in one process. What is in the file is kept.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch

import nsm

RESULTS = Path(__file__).parent / "results" / "quasi_newton.json"
WAYS = {
    "default": [],
    "preview": ["experiment=preview"],
    "fast": ["experiment=fast"],
}
FIGURES = (
    *(f"symmetric_dirichlet_{k}" for k in ("median", "mean", "p95")),
    *(f"start_symmetric_dirichlet_{k}" for k in ("median", "p95")),
    *("flipped_before_repair_percent", "flipped_percent"),
    *("landmark_error_mean_percent", "landmark_error_max_percent", "certified"),
)


def compared(meshes: Path, pair: str, known: dict[str, Any]) -> dict[str, Any]:
    """Seconds and figures of each way, from the neural surfaces of a pair; known ones are kept."""
    pair, _, domain = pair.partition(" ")
    names = [f"shrec07-{name}" for name in pair.split("-")]
    files = [str(meshes / f"{name}.off") for name in names]
    marks = [str(meshes / "landmarks" / f"{name}.vts") for name in names]
    short = ["trainer.max_steps=1", "certification.rounds=0", f"domain={domain or 'auto'}"]
    ready = nsm.map_pair(*files, marks, overrides=short, progress=False)
    result: dict[str, Any] = {**known, "domain": str(ready.source.surface.domain)}
    for way, overrides in WAYS.items():
        if way in known:
            continue
        start = time.process_time()
        f = nsm.map_pair(
            ready.source,
            ready.target,
            ready.landmarks.tolist(),
            overrides=overrides,
            progress=False,
        )
        seconds = time.process_time() - start
        result[way] = {
            "seconds": round(seconds, 1),
            **{key: round(float(f.metrics[key]), 4) for key in FIGURES},
        }
    return result


def table(known: dict[str, Any]) -> str:
    """The results as Markdown."""
    head = ["pair", "way", "seconds", "median", "mean", "95th percentile"]
    lines = [f"| {' | '.join([*head, 'landmarks, mean / largest'])} |", "|---" * 7 + "|"]
    for pair, ways in known.items():
        for way in WAYS:
            of = ways[way]
            energies = [f"{of[key]:.2f}" for key in FIGURES[:3]]
            errors = (of[f"landmark_error_{key}_percent"] for key in ("mean", "max"))
            row = [pair.replace("-", " → "), way, f"{of['seconds']:.1f}", *energies]
            row.append(" / ".join(f"{error:.3f} %" for error in errors))
            lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, required=True)
    parser.add_argument("--pairs", nargs="+", default=["384-388", "302-314", "381-393 disc"])
    given = parser.parse_args()
    torch.set_num_threads(1)
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for pair in given.pairs:
        if not WAYS.keys() <= known.get(pair, {}).keys():
            known[pair] = compared(given.meshes, pair, known.get(pair, {}))
            RESULTS.write_text(json.dumps(known, indent=2) + "\n")
    RESULTS.with_suffix(".md").write_text(table(known))


if __name__ == "__main__":
    main()
