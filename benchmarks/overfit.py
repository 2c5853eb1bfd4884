"""Error against time of overfitting a network to a surface: default settings and the paper's.

Time is the CPU time of a process that trains on one thread, so that figures from a busy machine are
comparable. The default is trained once for each budget, including its initialization by least
squares, with a schedule that ends with the budget. The published schedule has no end, so that one
run is measured at several times. Errors are those of :func:`nsm.results.overfit_metrics`, on points
that no training sees. Runs in the result file are not repeated.

    python benchmarks/overfit.py --meshes FOLDER
"""

from __future__ import annotations

import argparse
import json
import platform
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from training import MESHES, NO_MAP, Clock, OnTheClock, surface_of, train

from nsm.config import compose_config
from nsm.domains import Surface
from nsm.pipeline import quiet_lightning
from nsm.results import atomic_write, overfit_metrics
from nsm.results.callbacks import GradientWatch

RESULT = Path(__file__).parent / "results" / "overfit.json"


def _default(surface: Surface, minutes: float) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def at_mark(module: Any, seconds: float, step: int) -> None:
        found.update(steps=step, cpu_seconds=seconds)
        found["metrics"] = overfit_metrics(surface, module.map.eval())

    train(compose_config(), surface, [OnTheClock([60 * minutes], at_mark)], max_steps=-1)
    return found


def _paper(surface: Surface, minutes: list[float]) -> dict[float, dict[str, Any]]:
    config = compose_config(["experiment=paper"])
    found: dict[float, dict[str, Any]] = {}

    def at_mark(module: Any, seconds: float, step: int) -> None:
        found[seconds / 60] = {
            "steps": step,
            "cpu_seconds": seconds,
            "metrics": overfit_metrics(surface, module.map.eval()),
        }
        module.map.train()

    clock, watch = Clock([60 * m for m in minutes], at_mark), GradientWatch.of(config.trainer)
    trainer, module, seconds = train(config, surface, [clock, watch])
    for m in minutes:  # the stopping rule ended the training before that time
        found.setdefault(
            m,
            {
                "steps": trainer.global_step,
                "cpu_seconds": seconds,
                "stopped_by_rule": True,
                "metrics": overfit_metrics(surface, module.map.eval()),
            },
        )
    return found


def _store(entry: str, value: dict[str, Any], output: Path) -> None:
    # read again each time: two processes may write to one file
    results = json.loads(output.read_text()) if output.exists() else {"runs": {}}
    results["machine"] = {"processor": platform.machine(), "torch": torch.__version__}
    results["flips"] = NO_MAP
    results["runs"][entry] = value
    results["runs"] = dict(sorted(results["runs"].items()))
    output.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(output, (json.dumps(results, indent=1) + "\n").encode())


def _table(output: Path) -> str:
    """RMS in percent of the diagonal and mean normal error, as a Markdown table."""
    runs = json.loads(output.read_text())["runs"]
    columns = sorted({tuple(key.split("/")[1:]) for key in runs}, key=lambda c: (c[0], float(c[1])))
    # the default ends with its time; of the paper's training these are the first minutes
    names = {"default": "default", "paper": "the paper's first"}
    lines = [
        "| surface | " + " | ".join(f"{names[settings]} {m} min" for settings, m in columns) + " |",
        "|---" * (len(columns) + 1) + "|",
    ]
    for name in MESHES:
        cells = []
        for settings, minutes in columns:
            metrics = runs.get(f"{name}/{settings}/{minutes}", {}).get("metrics")
            cells.append(
                f"{metrics['rms_percent']:.3f} % / {metrics['normal_error_mean_degrees']:.1f}°"
                if metrics
                else "not run"
            )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, help="folder with the mesh files; else fetched")
    parser.add_argument("--names", nargs="+", default=list(MESHES), choices=list(MESHES))
    parser.add_argument("--minutes", nargs="+", type=float, default=[0.5, 1])
    parser.add_argument("--paper-minutes", nargs="+", type=float, default=[1, 5, 15])
    parser.add_argument("--settings", nargs="+", default=["default", "paper"])
    parser.add_argument("--output", type=Path, default=RESULT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quiet_lightning()
    done = json.loads(arguments.output.read_text())["runs"] if arguments.output.exists() else {}
    console = Console()

    if "default" in arguments.settings:
        for minutes in sorted(arguments.minutes):
            for name in arguments.names:
                key = f"{name}/default/{minutes:g}"
                if key not in done:
                    _store(
                        key, _default(surface_of(name, arguments.meshes), minutes), arguments.output
                    )
                    console.print(key)
    if "paper" in arguments.settings:
        for name in arguments.names:
            if any(f"{name}/paper/{m:g}" not in done for m in arguments.paper_minutes):
                for m, run in _paper(
                    surface_of(name, arguments.meshes), sorted(arguments.paper_minutes)
                ).items():
                    _store(f"{name}/paper/{m:g}", run, arguments.output)
                console.print(f"{name}/paper")
    table = _table(arguments.output)
    arguments.output.with_suffix(".md").write_text(table)
    print(table)


if __name__ == "__main__":
    main()
