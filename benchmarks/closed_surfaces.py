"""Closed surfaces on the disc, with a seam, and on the orbifold, without: default settings.

    python benchmarks/closed_surfaces.py --meshes FOLDER

Takes all closed meshes of genus 0 in the folder. Writes benchmarks/results/closed_surfaces.json,
and prints the tables of docs/surfaces.md; seconds are those of the processor, on one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

import nsm
from nsm.surfaces.given import given_mesh
from nsm.surfaces.loading import EXTENSIONS
from nsm.surfaces.topology import genus_and_boundary
from nsm.surfaces.validation import clean

RESULT = Path(__file__).parent / "results" / "closed_surfaces.json"
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


def closed_meshes(folder: Path) -> list[Path]:
    """The meshes of a folder that are closed and of genus 0, the smallest files first."""
    found = []
    for file in sorted(folder.iterdir(), key=lambda file: file.stat().st_size):
        if file.suffix.lower() in EXTENSIONS:
            mesh = given_mesh(file)
            if genus_and_boundary(clean(mesh.vertices, mesh.faces, mesh.name).faces) == (0, 0):
                found.append(file)
    return found


def section(results: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """The tables of docs/surfaces.md."""
    lines = [
        "| shape | domain | RMS | largest | normal error, mean | 95th percentile | "
        "gap along the seam | seconds |",
        "|" + "---|" * 8,
    ]
    for shape, of_domains in results.items():
        for domain, of in of_domains.items():
            seconds = of["preparation_seconds"] + of["training_seconds"]
            gap = f"{of['seam_gap_percent']:.3f}" if "seam_gap_percent" in of else "none"
            lines.append(
                f"| {shape if domain == DOMAINS[0] else ''} | {domain} | {of['rms_percent']:.4f} | "
                f"{of['max_percent']:.3f} | {of['normal_error_mean_degrees']:.2f} | "
                f"{of['normal_error_p95_degrees']:.1f} | {gap} | {seconds:.0f} |"
            )
    lines += ["", "| orbifold over disc | geometric mean | least | largest |", "|---|---|---|---|"]
    for name in ("rms_percent", "normal_error_mean_degrees", "normal_error_p95_degrees"):
        ratio = np.array([of["orbifold"][name] / of["disc"][name] for of in results.values()])
        mean = np.exp(np.log(ratio).mean())
        lines.append(f"| {name} | {mean:.3f} | {ratio.min():.3f} | {ratio.max():.3f} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("meshes"), help="folder of the meshes")
    parser.add_argument("--output", type=Path, default=RESULT)
    parser.add_argument("--only", nargs="+", metavar="SHAPE", help="the others stay as they are")
    given = parser.parse_args()
    results: dict[str, dict[str, dict[str, float]]] = {}
    if given.only and given.output.exists():
        results = json.loads(given.output.read_text())
    for file in closed_meshes(given.meshes):
        if given.only and file.stem not in given.only:
            continue
        results[file.stem] = {domain: measured(file, domain) for domain in DOMAINS}
        given.output.write_text(json.dumps(results, indent=1) + "\n")
        for domain, figures in results[file.stem].items():
            print(file.stem, domain, figures, flush=True)
    print("\n".join(section(results)))


if __name__ == "__main__":
    main()
