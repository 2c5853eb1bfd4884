"""Where the wait goes: CPU seconds of each stage, from raw files to the last file written, and the
most memory on the way.

Each case is a process of its own with an empty cache and one thread. A stage's seconds are its own:
those of a stage within it are left out. Seconds of the processes that a run starts count too.

    python benchmarks/waiting.py --meshes FOLDER [--cases NAME ...]
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from nsm.loading_libraries import loading_libraries

RESULTS = Path(__file__).parent / "results" / "waiting.json"
PAIR = ("shrec07-384", "shrec07-388")
LARGER = "shrec07-393"  # of 9,757 vertices
CASES = {
    "pair_map": "a pair map",
    "fast": "a pair map, experiment=fast",
    "adam": "a pair map, experiment=adam",
    "disc": "a pair map on the disc",
    "overfit": "a neural surface",
    "fit": "a neural surface, experiment=fit",
    "param": "a flattening",
}
# owner of a function, its name, and the stage that it is
STAGES = (
    ("nsm.pipeline.automatic_domain", "given_mesh", "reading"),
    ("nsm.pipeline.resolve_inputs", "given_mesh", "reading"),
    ("nsm.domains.surface", "given_mesh", "reading"),
    ("nsm.pipeline.automatic_domain", "clean", "cleaning"),
    ("nsm.domains.joint_preparation", "clean", "cleaning"),
    ("nsm.domains.preparation", "clean", "cleaning"),
    ("nsm.pipeline.resolve_inputs", "prepare_jointly", "layout on the domain"),
    ("nsm.domains.surface:Surface", "load", "layout on the domain"),
    ("nsm.pipeline.overfit", "fit_linear_skip", "φ: least-squares fit"),
    ("nsm.pipeline.overfit:OverfitTask", "build", "φ: least-squares fit"),
    ("nsm.pipeline.surface_cache", "_fill_side_by_side", "φ: side by side"),
    ("nsm.pipeline.surface_cache", "run_prepared", "φ: saving"),
    ("nsm.pipeline.overfit:OverfitTask", "measure", "φ: figures"),
    ("nsm.pipeline.runner", "trained", "training"),
    ("nsm.pipeline.runner", "certified", "certificate"),
    ("nsm.pipeline.pair_map:PairMapTask", "build", "start of the map"),
    ("nsm.pipeline.pair_map:PairMapTask", "use", "start of the map"),
    ("nsm.pipeline.param:ParamTask", "build", "start of the map"),
    ("nsm.pipeline.pair_map:PairMapTask", "measure", "figures"),
    ("nsm.pipeline.param:ParamTask", "measure", "figures"),
    ("nsm.pipeline.pair_map:PairMapTask", "save", "saving"),
    ("nsm.pipeline.param:ParamTask", "save", "saving"),
    ("nsm.pipeline.pair_map:PairMapTask", "write_artefacts", "pictures and meshes"),
    ("nsm.pipeline.param:ParamTask", "write_artefacts", "pictures and meshes"),
    ("nsm.pipeline.overfit:OverfitTask", "write_artefacts", "pictures and meshes"),
)
FIGURES = {
    "start_symmetric_dirichlet_median": "symmetric Dirichlet as h starts, median",
    "symmetric_dirichlet_median": "symmetric Dirichlet at the end, median",
    "flipped_before_repair_percent": "flipped before repair, %",
    "flipped_percent": "flipped after repair, %",
}
AFTER = "pictures and meshes"  # what the user does not wait for to see the figures
OWN_TRAINING = "φ: training"
REST = "the rest"


def cpu_seconds() -> float:
    """CPU seconds of this process and of those that it started and that have ended."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def peak_mib() -> float:
    """The most memory of this process so far, in MiB."""
    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes / 1024 if sys.platform != "darwin" else kilobytes / 1024**2


class Clock:
    """CPU seconds of each stage of a run, each without the stages within it.

    Args:
        of_surface: the run's own training is that of φ, not one for a map.
    """

    def __init__(self, of_surface: bool) -> None:
        self.spent: dict[str, float] = {}
        self.of_surface = of_surface
        self._running = [REST]
        self._since = cpu_seconds()

    def _turn(self) -> None:
        now = cpu_seconds()
        stage = self._running[-1]
        self.spent[stage] = self.spent.get(stage, 0.0) + now - self._since
        self._since = now

    def around(self, owner: Any, name: str, stage: str) -> None:
        """Count the calls of ``owner.name``, a function or method, for a stage."""
        found = inspect.getattr_static(owner, name)
        inner = found.__func__ if isinstance(found, classmethod) else found

        def measured(*args: Any, **kwargs: Any) -> Any:
            of_surface = self.of_surface or any(one.startswith("φ") for one in self._running)
            named = OWN_TRAINING if stage == "training" and of_surface else stage
            self._turn()
            self._running.append(named)
            try:
                return inner(*args, **kwargs)
            finally:
                self._turn()
                self._running.pop()

        setattr(owner, name, classmethod(measured) if inner is not found else measured)

    def stop(self) -> dict[str, float]:
        """Seconds of each stage."""
        self._turn()
        return {name: round(value, 2) for name, value in self.spent.items()}


def overrides_of(case: str, meshes: Path) -> list[str]:
    """The settings of a case."""
    if case == "fit":
        return ["task=overfit", f"surface.path={meshes / LARGER}.off", "experiment=fit"]
    first = str(meshes / f"{PAIR[0]}.off")
    if case in ("overfit", "param"):
        domain = [] if case == "overfit" else ["domain=disc"]
        return [f"task={case}", f"surface.path={first}", *domain]
    marks = [str(meshes / "landmarks" / f"{name}.vts") for name in PAIR]
    ways = {"fast": ["experiment=fast"], "adam": ["experiment=adam"], "disc": ["domain=disc"]}
    return [
        "task=pair_map",
        f"source={first}",
        f"target={meshes / PAIR[1]}.off",
        f"landmarks=[{','.join(marks)}]",
        *ways.get(case, []),
    ]


def run(case: str, meshes: Path, extra: list[str]) -> dict[str, Any]:
    """One case in this process, with a clock on its stages."""
    begun = time.perf_counter()
    clock = Clock(case in ("overfit", "fit"))
    overrides = [*overrides_of(case, meshes), "trainer.progress=false", *extra]
    with loading_libraries(frozen=True):  # as the command does
        import torch

        from nsm.config import compose_config
        from nsm.config_validation import checked
        from nsm.pipeline import run

        config = checked(compose_config(overrides), overrides)
    torch.set_num_threads(1)
    clock._turn()
    imports = cpu_seconds()  # since the process began
    clock.spent = {"imports": imports}
    for place, name, stage in STAGES:
        module, _, kind = place.partition(":")
        owner = importlib.import_module(module)
        clock.around(getattr(owner, kind) if kind else owner, name, stage)
    with tempfile.TemporaryDirectory() as folder:
        run(config, Path(folder))
        spent = clock.stop()
        metrics = json.loads((Path(folder) / "metrics.json").read_text())
    figures = metrics["metrics"]
    kept = (
        *(f"{at}symmetric_dirichlet_{k}" for at in ("start_", "") for k in ("median", "p95")),
        *(f"landmark_error_{k}_percent" for k in ("mean", "max")),
        *("flipped_before_repair_percent", "flipped_percent", "certified"),
        *("rms_percent", "normal_error_mean_degrees"),
    )
    return {
        "stages": spent,
        "cpu_seconds": round(sum(spent.values()), 2),
        "wall_seconds": round(time.perf_counter() - begun, 1),
        "peak_mib": round(peak_mib()),
        "figures": {key: round(float(figures[key]), 5) for key in kept if key in figures},
    }


def apart(case: str, meshes: Path, extra: list[str]) -> dict[str, Any]:
    """One case in a process of its own, with an empty cache."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NSM_CACHE": cache, "OMP_NUM_THREADS": "1"}
        command = [sys.executable, __file__, "--meshes", str(meshes), "--here", case, *extra]
        ended = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    found: dict[str, Any] = json.loads(ended.stdout.decode().splitlines()[-1])
    return found


def section(results: dict[str, Any]) -> list[str]:
    """The results as a section of docs/performance.md."""
    cases = {name: results["cases"][name] for name in CASES if name in results["cases"]}
    order = dict.fromkeys(
        ["imports", *(s for _, _, s in STAGES[:9]), *(s for _, _, s in STAGES[9:12])]
    )
    order |= dict.fromkeys([OWN_TRAINING, "φ: figures", "start of the map"])
    order |= dict.fromkeys(["training", "certificate", "figures", "saving", REST, AFTER])
    lines = [
        "",
        "## From raw files to the last file written",
        "",
        f"CPU seconds of each stage on {results['machine']}, one thread, with an empty cache of "
        "surfaces and compiled loops (`make bench-waiting MESHES=FOLDER`). Maps are from "
        "shrec07-384 to shrec07-388 with 21 landmarks; their neural surfaces are made side by "
        "side, so that the wait by the clock is shorter. The neural surface and the flattening are "
        f"of shrec07-384; by experiment=fit, of {LARGER}, which has 9,757 vertices.",
        "",
        "| stage | " + " | ".join(CASES[name] for name in cases) + " |",
        "|---" * (len(cases) + 1) + "|",
    ]
    for stage in order:
        row = [of["stages"].get(stage) for of in cases.values()]
        if any(value is not None for value in row):
            cells = ("–" if value is None else f"{value:.1f}" for value in row)
            lines.append(f"| {stage} | " + " | ".join(cells) + " |")
    totals = (f"**{of['cpu_seconds']:.1f}**" for of in cases.values())
    lines.append("| **total** | " + " | ".join(totals) + " |")
    before = (of["cpu_seconds"] - of["stages"].get(AFTER, 0.0) for of in cases.values())
    shown = " | ".join(f"{s:.1f}" for s in before)
    lines.append(f"| until the figures are printed | {shown} |")
    peaks = ("–" if "peak_mib" not in of else str(of["peak_mib"]) for of in cases.values())
    lines.append("| most memory, MiB | " + " | ".join(peaks) + " |")
    for key, label in FIGURES.items():
        told = [of["figures"].get(key) for of in cases.values()]
        cells = ("–" if value is None else f"{value:.3f}" for value in told)
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, required=True)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--here", choices=CASES, help="run one case in this process")
    parser.add_argument("--output", type=Path, default=RESULTS)
    given, extra = parser.parse_known_args()
    if given.here:
        print(json.dumps(run(given.here, given.meshes, extra)))
        return
    for case in given.cases:
        apart(case, given.meshes, extra)  # compiles the loops, if nothing did
        found = apart(case, given.meshes, extra)
        print(case, json.dumps(found, indent=1), flush=True)
        results = json.loads(given.output.read_text()) if given.output.exists() else {"cases": {}}
        results["machine"] = f"{os.cpu_count()} CPU cores, {platform.machine()}"
        results["cases"][case] = found
        given.output.write_text(json.dumps(results, indent=1) + "\n")
    print("\n".join(section(results)))


if __name__ == "__main__":
    main()
