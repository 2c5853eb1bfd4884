"""Closed surfaces on the disc, with a seam, and on the orbifold, without: default settings.

    python benchmarks/closed_surfaces.py --meshes FOLDER

Writes benchmarks/results/closed_surfaces.json; seconds are those of the processor, on one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import nsm

RESULT = Path(__file__).parent / "results" / "closed_surfaces.json"
SHAPES = ("cow.obj", "shrec07-384.off", "homer.obj")
DOMAINS = ("disc", "orbifold")
FIGURES = (
    "rms_percent",
    "max_percent",
    "hausdorff_mesh_to_phi_percent",
    "normal_error_mean_degrees",
    "normal_error_p95_degrees",
    "seam_gap_percent",
)


def measured(path: Path, domain: str) -> dict[str, float]:
    """The figures of one neural surface, and the seconds that it took."""
    start = time.process_time()
    surface = nsm.Surface.load(path, domain=domain, cache=False)
    prepared = time.process_time()
    phi = nsm.overfit(surface, progress=False, trainer={"threads": 1}, logger="none")
    done = time.process_time()
    return {
        **{name: round(phi.metrics[name], 4) for name in FIGURES if name in phi.metrics},
        "domain_median": round(surface.quality["median_symmetric_dirichlet"], 2),
        "preparation_seconds": round(prepared - start, 1),
        "training_seconds": round(done - prepared, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("meshes"), help="folder of the meshes")
    folder = parser.parse_args().meshes
    results: dict[str, dict[str, dict[str, float]]] = {}
    for name in SHAPES:
        results[Path(name).stem] = {d: measured(folder / name, d) for d in DOMAINS}
        RESULT.write_text(json.dumps(results, indent=1) + "\n")
        for domain, figures in results[Path(name).stem].items():
            print(name, domain, figures, flush=True)


if __name__ == "__main__":
    main()
