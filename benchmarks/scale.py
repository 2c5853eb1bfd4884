"""Large meshes and large collections: CPU time and peak memory of each stage of a whole run.

Each case is a separate process, from raw meshes to the files in the run folder, with one thread.
Trainings are short: their steps cost the same on every mesh, and speed.py measures them.

    python benchmarks/scale.py [--cases NAME ...] [--pictures FOLDER]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from waiting import cpu_seconds, peak_mib

from nsm.surfaces import shapes

RESULTS = Path(__file__).parent / "results" / "scale.json"
STEPS, PHI_STEPS, COLLECTION_STEPS = 1000, 300, 100
SURFACES, LIMIT_GIB = 20, 8
LANDMARKS = [0, 400, 900, 1500]


def bumps(points: np.ndarray, seed: int, waves: int, finest: float) -> np.ndarray:
    """A sum of waves (N,) in all directions, up to ``finest`` radians per unit of length."""
    random, height = np.random.default_rng(seed), np.zeros(len(points))
    for k in range(waves):
        way = random.normal(size=3)
        way *= (1.5 + finest * (k / waves) ** 1.5) / np.linalg.norm(way)
        height += np.sin(points @ way + random.uniform(0, 2 * np.pi)) / (
            4 + 1.4 * np.linalg.norm(way)
        )
    return height


def closed_mesh() -> shapes.Mesh:
    """A ball with bumps: 1,310,720 faces."""
    vertices, faces = shapes.sphere(8)
    return vertices * (1 + 0.8 * bumps(vertices, 0, 24, 12.0))[:, None], faces


def open_mesh() -> shapes.Mesh:
    """Hills over a square: 1,002,528 faces."""
    vertices, faces = shapes.plane(709)
    vertices[:, 2] = 0.5 * bumps(vertices, 1, 32, 25.0)
    return vertices, faces


def bowl(seed: int) -> shapes.Mesh:
    """One of many bowls with bumps: 5,400 faces; equal vertex numbers correspond."""
    vertices, faces = shapes.hemisphere(30)
    return vertices * (1 + 0.8 * bumps(vertices, 100 + seed, 12, 4.0))[:, None], faces


def write_obj(path: Path, mesh: shapes.Mesh) -> str:
    vertices, faces = mesh
    with path.open("w") as stream:
        np.savetxt(stream, vertices, fmt="v %.7f %.7f %.7f")
        np.savetxt(stream, faces + 1, fmt="f %d %d %d")
    return str(path)


class Stages:
    """CPU seconds of functions of the pipeline, and the peak memory of the process after them."""

    def __init__(self) -> None:
        self.taken: dict[str, dict[str, float]] = {}
        self.within = False

    def around(self, owner: Any, name: str, stage: str) -> None:
        """Count each call of ``owner.name``, a function or method, for a stage, unless it is part
        of another stage."""
        inner: Callable[..., Any] = getattr(owner, name)

        def measured(*args: Any, **kwargs: Any) -> Any:
            if self.within:
                return inner(*args, **kwargs)
            start, self.within = cpu_seconds(), True
            try:
                return inner(*args, **kwargs)
            finally:
                self.within = False
                entry = self.taken.setdefault(stage, {"cpu_seconds": 0.0, "peak_mib": 0.0})
                entry["cpu_seconds"] += cpu_seconds() - start
                entry["peak_mib"] = peak_mib()

        setattr(owner, name, measured)


def overfit(mesh: Callable[[], shapes.Mesh], folder: Path) -> dict[str, Any]:
    """task=overfit from a raw mesh."""
    from nsm.pipeline import runner
    from nsm.pipeline.overfit import OverfitTask

    stages = Stages()
    for owner, name, stage in (
        (OverfitTask, "prepare", "preparation"),
        (runner, "trained", f"training, {STEPS} steps"),
        (OverfitTask, "measure", "figures"),
        (OverfitTask, "save", "saving"),
        (OverfitTask, "write_artefacts", "meshes and pictures"),
    ):
        stages.around(owner, name, stage)
    file = write_obj(folder / "mesh.obj", mesh())
    settings = ["task=overfit", f"surface.path={file}", f"trainer.max_steps={STEPS}"]
    found = whole_run(settings, folder / "run", stages)
    return {**found, "preparation": metrics(folder)["preparation"]}


def collection(folder: Path) -> dict[str, Any]:
    """task=collection_map of many surfaces, all ordered pairs of them."""
    from nsm.pipeline import resolve_inputs, runner
    from nsm.pipeline.collection_map import CollectionMapTask

    stages = Stages()
    for owner, name, stage in (
        (resolve_inputs, "prepare_jointly", "preparation"),
        (resolve_inputs, "cached_surfaces", f"neural surfaces, {PHI_STEPS} steps"),
        (runner, "trained", f"training, {COLLECTION_STEPS} steps"),
        (runner, "certified", "certificates"),
        (CollectionMapTask, "measure", "figures"),
        (CollectionMapTask, "write_artefacts", "meshes and pictures"),
    ):
        stages.around(owner, name, stage)
    files = [write_obj(folder / f"bowl{k}.obj", bowl(k)) for k in range(SURFACES)]
    landmarks = folder / "landmarks.json"
    landmarks.write_text(json.dumps([LANDMARKS] * SURFACES))
    settings = [
        "task=collection_map",
        f"trainer.max_steps={COLLECTION_STEPS}",
        f"surfaces=[{','.join(files)}]",
        f"landmarks={landmarks}",
        f'phi.overrides=["trainer.max_steps={PHI_STEPS}"]',
        # so short a training leaves flips, and their repair would take longer than all the rest:
        # flips after it are those before
        "certification.repair=false",
    ]
    found = whole_run(settings, folder / "run", stages)
    pairs = metrics(folder)["metrics"]["pairs"].values()
    told = (
        "start_symmetric_dirichlet_median",
        "symmetric_dirichlet_median",
        "flipped_before_repair_percent",
        "flipped_percent",
    )
    return {
        **found,
        "pairs": len(pairs),
        "certified_pairs": sum(pair["certified"] for pair in pairs),
        **{key: float(np.median([pair[key] for pair in pairs])) for key in told},
        "flipped_percent_largest": max(pair["flipped_percent"] for pair in pairs),
    }


def metrics(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "run" / "metrics.json").read_text())
    return found


def whole_run(settings: list[str], folder: Path, stages: Stages) -> dict[str, Any]:
    from nsm.config import compose_config
    from nsm.pipeline import run

    start = cpu_seconds()
    run(compose_config([*settings, "seed=0", "trainer.progress=false"]), folder)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return {
        "stages": stages.taken,
        "cpu_seconds": cpu_seconds() - start,
        "peak_mib": peak_mib(),
        "output_mib": size / 2**20,
        "output_files": sum(file.is_file() for file in folder.rglob("*")),
    }


CASES: dict[str, tuple[str, Callable[[Path], dict[str, Any]]]] = {
    "closed": ("a closed mesh of 1.31 M faces", lambda folder: overfit(closed_mesh, folder)),
    "open": ("an open mesh of 1.00 M faces", lambda folder: overfit(open_mesh, folder)),
    "collection": (f"a collection of {SURFACES} surfaces of 5,400 faces", collection),
}


def section(results: dict[str, Any]) -> list[str]:
    """The results as a section of docs/performance.md."""
    lines = [
        "",
        "## Large meshes and collections",
        "",
        f"`make bench-scale` measures these on {results['machine']}, with one thread: from raw "
        "meshes to the files in the run folder, with short trainings. The table has CPU time, and "
        "the peak memory of the process at the end of each stage; the limit is "
        f"{LIMIT_GIB * 1024} MiB.",
        "",
        "| what | stage | CPU seconds | peak MiB |",
        "|---|---|---|---|",
    ]
    cases = {name: results["cases"][name] for name in CASES if name in results["cases"]}
    for name, found in cases.items():
        for stage, taken in found["stages"].items():
            lines.append(
                f"| {CASES[name][0]} | {stage} | {taken['cpu_seconds']:.0f} | "
                f"{taken['peak_mib']:.0f} |"
            )
        lines.append(
            f"| | **total** | **{found['cpu_seconds']:.0f}** | **{found['peak_mib']:.0f}** |"
        )
    lines.append("")
    for name, found in cases.items():
        text = (
            f"{CASES[name][0][0].upper()}{CASES[name][0][1:]}: {found['output_files']} files of "
            f"{found['output_mib']:.0f} MiB"
        )
        if "pairs" in found:
            text += (
                f", {found['certified_pairs']} of {found['pairs']} ordered pairs certified "
                "without repair, after so short a training; of the others up to "
                f"{found['flipped_percent_largest']:.3f} % of the triangles are flipped. Median "
                f"symmetric Dirichlet {found['symmetric_dirichlet_median']:.2f}, as the maps start "
                f"{found['start_symmetric_dirichlet_median']:.2f}."
            )
        else:
            quality = found["preparation"]
            text += (
                f", {quality['flipped_triangles']:.0f} flipped triangles in the domain (none is "
                "repaired later, as there is no map), median symmetric "
                f"Dirichlet of the domain {quality['median_symmetric_dirichlet']:.2f}."
            )
        lines += [text, ""]
    return lines[:-1]


def run_case(name: str, pictures: Path | None) -> dict[str, Any]:
    """Run a case in a separate process, with empty caches."""
    with tempfile.TemporaryDirectory() as place:
        output = Path(place) / "found.json"
        command = [sys.executable, __file__, "--inside", name, "--folder", place]
        environment = {
            **os.environ,
            "OMP_NUM_THREADS": "1",
            "NSM_CACHE": str(Path(place) / "cache"),
        }
        subprocess.run(command, check=True, env=environment)
        if pictures is not None:
            (pictures / name).mkdir(parents=True, exist_ok=True)
            for file in (Path(place) / "run").glob("*.png"):
                shutil.copy(file, pictures / name)
        found: dict[str, Any] = json.loads(output.read_text())
        return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--pictures", type=Path, help="folder for the runs' pictures")
    parser.add_argument("--inside", choices=CASES, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inside:
        found = CASES[arguments.inside][1](arguments.folder)
        (arguments.folder / "found.json").write_text(json.dumps(found))
        return
    for name in arguments.cases:  # stored one by one: an interrupted run keeps what it has
        found = run_case(name, arguments.pictures)
        results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"cases": {}}
        results["machine"] = f"{os.cpu_count()} CPU cores, {platform.machine()}"
        results["cases"][name] = found
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
        import speed

        speed.write_page()
        print("\n".join(section(results)), flush=True)


if __name__ == "__main__":
    main()
