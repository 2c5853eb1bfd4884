"""What makes training need fewer steps: one change from a base at a time, at equal time.

Each trial overfits one mesh with the settings of BASE and one change, for a budget of CPU time of
one thread that includes the initialization of the network. Errors are measured at marks, on points
that no training sees; the time for that does not count. A schedule with an end follows the clock:
it ends with the budget, as if ``trainer.max_steps`` were the number of steps in the budget,
whatever else the machine does.

Each mesh and trial has a JSON file. Existing files are kept, so that an interrupted run continues
where it stopped:

    python benchmarks/steps.py --meshes FOLDER [--names MESH ...] [--only TRIAL ...]
"""

from __future__ import annotations

import argparse
import json
import platform
import re
from functools import partial
from pathlib import Path
from typing import Any

import torch
from candidates import exchanged, parted, register
from rich.console import Console
from training import MESHES, NO_MAP, OnTheClock, surface_of, train

from nsm.config import compose_config
from nsm.pipeline import quiet_lightning
from nsm.results import atomic_write, pointwise_metrics
from nsm.results.wrinkles import normal_variation

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "steps"
PICTURES = ROOT / "docs" / "pictures"
NAMES = ("bunny", "shrec07-384", "igea")
MARKS = (5.0, 10.0, 20.0, 30.0)  # seconds of one thread
STEPS = 3300  # of the default within the budget, about
HELD_OUT = 30_000
LATE = 1.15  # the first step that ends after a mark counts for it up to this factor

# The base of all trials: the default settings of the first trials, spelled out by group, so that a
# trial does not depend on today's default.
BASE: dict[str, list[str]] = {
    "initialization": ["initialization=random"],
    "domain": ["domain=disc"],
    "surface": ["surface.parameterization=slim"],
    "map": [
        "map=mlp",
        "map.width=64",
        "map.depth=1",
        "map.block=plain",
        "map.initialization=kaiming",
        "map.linear_skip=none",
    ],
    "activation": ["activation=softplus", "activation.beta=10"],
    "encoding": [
        "encoding=spline_grid",
        "encoding.resolutions=[16,64,256]",
        "encoding.features=4",
        "encoding.degree=2",
        "encoding.extent=1.05",
    ],
    "loss_weights": ["loss_weights=overfit", "loss_weights.normal=0.01"],
    "sampler": [
        "sampler=fresh_with_vertices",
        "sampler.vertex_share=0.1",
        "sampler.domain_share=0",
        "sampler.pool=null",
    ],
    "data": ["data.batch_size=1024"],
    "optimizer": [
        "optimizer=adam",
        "optimizer.lr=3e-3",
        "optimizer.encoding_lr=3e-2",
        "optimizer.betas=[0.9,0.99]",
        "optimizer.eps=1e-12",
    ],
    "scheduler": ["scheduler=cosine", "scheduler.warmup=100", "scheduler.final=0"],
    "trainer": ["trainer.gradient_clip=null", "trainer.precision=float32", "trainer.compile=false"],
}

# initialization by least squares, then a training at small rates
START = ["map.linear_skip=fitted", "encoding.resolutions=[32,128,512]"]
FITTED = [*START, "scheduler.peak=0.003"]

LBFGS = ["optimizer=lbfgs", "scheduler.warmup=0"]
GAUSS_NEWTON = ["candidate=gauss_newton", "optimizer.lr=1", "scheduler.warmup=0"]
SOAP = ["optimizer=muon", "candidate=preconditioned", "candidate.kind=soap"]
SHAMPOO = [*SOAP[:-1], "candidate.kind=shampoo"]

# the changes from BASE, by topic
TRIALS: dict[str, dict[str, list[str]]] = {
    "default": {
        "default": [],
        "default, seed 1": ["seed=1"],
        "default, seed 2": ["seed=2"],
        # for a mesh whose other rows were measured on an earlier layout
        "default, new layout": [],
        "default, new layout, seed 1": ["seed=1"],
        "paper": ["experiment=paper"],
    },
    "encoding": {
        "no encoding": ["encoding=identity"],
        "no encoding, residual 128 × 4": ["encoding=identity", "map=residual"],
        "Fourier, 64, σ = 2": ["encoding=fourier"],
        "Fourier, 128, σ = 4": [
            "encoding=fourier",
            "encoding.features=128",
            "encoding.sigma=4",
        ],
        "Fourier, 64, σ = 2, residual 128 × 4": ["encoding=fourier", "map=residual"],
        "grid 256": ["encoding.resolutions=[256]"],
        "grid 16, 64": ["encoding.resolutions=[16,64]"],
        "grid 64, 256": ["encoding.resolutions=[64,256]"],
        "grid 16, 64, 256, 512": ["encoding.resolutions=[16,64,256,512]"],
        "grid 32, 128, 512": ["encoding.resolutions=[32,128,512]"],
        "grid 16, 32, 64, 128, 256": ["encoding.resolutions=[16,32,64,128,256]"],
        "grid of 2 features": ["encoding.features=2"],
        "grid of 8 features": ["encoding.features=8"],
        "grid of degree 3": ["encoding.degree=3"],
    },
    "other grids": {
        "coarse to fine": ["candidate=coarse_to_fine"],
        "coarse to fine, 16, 32, 64, 128, 256": [
            "encoding.resolutions=[16,32,64,128,256]",
            "candidate=coarse_to_fine",
        ],
        "hash grid, 8 levels to 256": ["encoding=hash_grid", "encoding.finest=256"],
        "hash grid, 8 levels to 512": ["encoding=hash_grid"],
    },
    "least squares": {
        "read-out of features": ["map.linear_skip=linear"],
        "fitted": ["map.linear_skip=fitted"],
        "fitted, rates 1e-4": [
            "map.linear_skip=fitted",
            "optimizer.lr=1e-4",
            "optimizer.encoding_lr=1e-4",
        ],
        "fitted, rates 1e-3, 1e-4": [
            "map.linear_skip=fitted",
            "optimizer.lr=1e-3",
            "optimizer.encoding_lr=1e-4",
        ],
        # today's default, initialization=fitted
        "fitted, grid 32, 128, 512": FITTED,
        "fitted, Fourier, 64": ["map.linear_skip=fitted", "encoding=fourier"],
    },
    "second order": {
        "Gauss–Newton": GAUSS_NEWTON,
        "Gauss–Newton, batch 4,096": [*GAUSS_NEWTON, "data.batch_size=4096"],
        "Gauss–Newton, batch 16,384": [*GAUSS_NEWTON, "data.batch_size=16384"],
    },
    # all with grid 32, 128, 512
    "from the fitted start": {
        "fitted, hardly trained": [*START, "scheduler.peak=3e-6"],
        "fitted, Muon": [*FITTED, "optimizer=muon"],
        "fitted, SOAP": [*FITTED, *SOAP],
        "fitted, by error": [*FITTED, "candidate=by_error"],
        "fitted, batch 256 to 8,192": [*FITTED, "candidate=growing_batch"],
        "fitted, L-BFGS, batch 16,384": [*START, *LBFGS, "data.batch_size=16384"],
        "fitted, Gauss–Newton": [*START, *GAUSS_NEWTON],
        "fitted, Gauss–Newton, batch 16,384": [*START, *GAUSS_NEWTON, "data.batch_size=16384"],
    },
    "network": {
        "32 × 1": ["map.width=32"],
        "128 × 1": ["map.width=128"],
        "64 × 2": ["map.depth=2"],
        "64 × 2, residual": ["map.depth=2", "map.block=pre"],
        "SiLU": ["activation=silu"],
    },
    "domain": {
        "Tutte": ["surface.parameterization=tutte"],
        "SLIM, boundary held": ["surface.parameterization=slim_held"],
        "square": ["domain=square"],
    },
    "samples": {
        "no vertices": ["sampler=fresh"],
        "no vertices, new layout": ["sampler=fresh"],
        "half vertices": ["sampler.vertex_share=0.5"],
        "half uniform in Ω": ["sampler.domain_share=0.5"],
        "a fifth uniform in Ω": ["sampler.domain_share=0.2"],
        "pool of 500,000": ["sampler=pool"],
        "by error": ["candidate=by_error"],
        "by error, seed 1": ["candidate=by_error", "seed=1"],
        "by error, not weighted": ["candidate=by_error", "candidate.weighted=false"],
        "batch 256 to 8,192": ["candidate=growing_batch"],
        "batch 256": ["data.batch_size=256"],
        "batch 512": ["data.batch_size=512"],
        "batch 2,048": ["data.batch_size=2048"],
        "batch 8,192": ["data.batch_size=8192"],
    },
    "optimizer": {
        "AdamW": ["optimizer=adamw", "optimizer.lr=3e-3", "optimizer.encoding_lr=3e-2"],
        "RMSProp": ["optimizer=rmsprop", "optimizer.lr=3e-3", "+optimizer.encoding_lr=3e-2"],
        "SGD": ["optimizer=sgd", "optimizer.lr=3e-2", "+optimizer.encoding_lr=10"],
        "Adam, rates a third": ["optimizer.lr=1e-3", "optimizer.encoding_lr=1e-2"],
        "Adam, rates tripled": ["optimizer.lr=1e-2", "optimizer.encoding_lr=1e-1"],
        "Adam, one rate": ["optimizer.encoding_lr=3e-3"],
        "Adam, β₂ = 0.999": ["optimizer.betas=[0.9,0.999]"],
        "Muon": ["optimizer=muon"],
        "Muon, seed 1": ["optimizer=muon", "seed=1"],
        "Muon, rates a third": [
            "optimizer=muon",
            "optimizer.lr=1e-3",
            "optimizer.encoding_lr=1e-2",
        ],
        "SOAP": SOAP,
        "SOAP, seed 1": [*SOAP, "seed=1"],
        "Shampoo": SHAMPOO,
        "L-BFGS, batch 4,096": [*LBFGS, "data.batch_size=4096"],
        "L-BFGS, batch 16,384": ["optimizer=lbfgs", "data.batch_size=16384"],
    },
    "schedule": {
        "constant": ["scheduler=constant"],
        "warm restarts": ["scheduler=sgdr"],
        "cosine, no warmup": ["scheduler.warmup=0"],
    },
    "loss": {
        "no normals": ["loss_weights=positions"],
        "λ_n = 0.001": ["loss_weights.normal=0.001"],
    },
}


def in_full(changes: list[str]) -> list[str]:
    """All settings of a trial: its changes, and BASE for the groups that it does not choose.

    An experiment replaces BASE.
    """
    chosen = {change.partition("=")[0] for change in changes}
    if "experiment" in chosen:
        return changes
    kept = [setting for group in BASE if group not in chosen for setting in BASE[group]]
    return kept + changes


def trial(settings: list[str], name: str, meshes: Path | None) -> dict[str, Any]:
    """Errors at the marks while one mesh is overfitted with these settings."""
    settings, candidate = parted(settings)
    config = compose_config([*settings, f"trainer.max_steps={STEPS}"])
    place = {"domain": config.domain, "parameterization": config.surface.parameterization}
    surface = surface_of(name, meshes, **place)
    curve: list[dict[str, Any]] = []

    def at_mark(module: Any, seconds: float, step: int) -> None:
        if clock.spent > LATE * seconds:  # the initialization took longer than the mark
            return
        found = pointwise_metrics(surface, module.map.eval(), samples=HELD_OUT)
        curve.append({"cpu_seconds": seconds, "steps": step, **found})
        module.map.train()

    clock = OnTheClock(MARKS, at_mark)
    piece = partial(exchanged, settings=candidate, progress=lambda: clock.progress)
    module = train(config, surface, [clock], max_steps=-1, exchanged=piece)[1]
    return {"curve": curve, "wrinkles": normal_variation(surface, module.map.eval())}


def slug(trial_name: str) -> str:
    """The file name of a trial."""
    plain = trial_name.replace("×", "x").replace("σ", "sigma").replace("λ", "lambda")
    plain = plain.replace("β₂", "beta2").replace("Ω", "domain")
    plain = re.sub(r"(?<=\d\d),(?=\d{3})", "", plain)
    return re.sub(r"[^a-z0-9.=]+", "-", plain.lower()).strip("-")


def results() -> dict[str, dict[str, Any]]:
    """All stored results: mesh to trial to result, in the order of TRIALS."""
    found: dict[str, dict[str, Any]] = {}
    for name in NAMES:
        for trials in TRIALS.values():
            for key in trials:
                file = RESULTS / name / f"{slug(key)}.json"
                if file.exists():
                    found.setdefault(name, {})[key] = json.loads(file.read_text())
    return found


def tables() -> str:
    """All results as Markdown: RMS in percent of the diagonal at each mark, normals at the end."""
    parts = []
    for name, found in results().items():
        head = ["trial", *(f"{mark:g} s" for mark in MARKS), "normals", "wrinkles", "steps"]
        lines = [f"## {name}", "", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
        for trials in TRIALS.values():
            for key in (key for key in trials if key in found):
                curve, wrinkles = found[key]["curve"], found[key]["wrinkles"]
                at = {point["cpu_seconds"]: f"{point['rms_percent']:.4f}" for point in curve}
                cells = [at.get(mark, "not yet") for mark in MARKS]
                cells.append(f"{curve[-1]['normal_error_mean_degrees']:.2f}°")
                cells.append(f"{wrinkles['normal_variation_error_degrees']:.2f}°")
                cells.append(f"{curve[-1]['steps']}")
                lines.append(f"| {key} | " + " | ".join(cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def picture(name: str, found: dict[str, Any]) -> None:
    """Draw the curves of one mesh: a panel for each topic, with the default in each."""
    from cycler import cycler
    from matplotlib.colors import TABLEAU_COLORS
    from matplotlib.figure import Figure

    topics = {
        topic: shown
        for topic, trials in TRIALS.items()
        if (shown := [key for key in trials if key in found])
    }
    columns = 3
    rows = -(-len(topics) // columns)
    figure = Figure(figsize=(5 * columns, 4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for axis, (topic, shown) in zip(axes, topics.items(), strict=False):
        axis.set_prop_cycle(cycler(linestyle=["-", "--"]) * cycler(color=TABLEAU_COLORS.values()))
        for key in shown if topic == "default" else ["default", *shown]:
            curve = found[key]["curve"] if key in found else []
            axis.plot(
                [point["cpu_seconds"] for point in curve],
                [point["rms_percent"] for point in curve],
                label=key,
                marker="o",
                markersize=3,
                **({"color": "black", "linewidth": 2.5} if key == "default" else {}),
            )
        axis.set(title=topic, xscale="log", yscale="log")
        axis.set_xticks(MARKS, [f"{mark:g}" for mark in MARKS])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    for axis in axes[len(topics) :]:
        axis.set_axis_off()
    figure.supxlabel("seconds of one CPU thread")
    figure.supylabel("RMS distance, % of the diagonal")
    figure.savefig(PICTURES / f"steps-{name}.png", dpi=90)


def main() -> None:
    every = [key for trials in TRIALS.values() for key in trials]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, help="folder with the mesh files; else fetched")
    parser.add_argument("--names", nargs="+", default=list(NAMES), choices=list(MESHES))
    parser.add_argument("--only", nargs="+", default=every, choices=every, metavar="TRIAL")
    parser.add_argument("--no-tables", action="store_true", help="write no table or pictures")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quiet_lightning()
    register()
    console = Console()
    for name in arguments.names:
        for topic, trials in TRIALS.items():
            for key in (key for key in trials if key in arguments.only):
                file = RESULTS / name / f"{slug(key)}.json"
                if file.exists():
                    continue
                result = {
                    "mesh": name,
                    "topic": topic,
                    "trial": key,
                    "overrides": in_full(trials[key]),
                    "flips": NO_MAP,
                    "torch": torch.__version__,
                    "machine": platform.machine(),
                    **trial(in_full(trials[key]), name, arguments.meshes),
                }
                file.parent.mkdir(parents=True, exist_ok=True)
                atomic_write(file, (json.dumps(result, indent=1) + "\n").encode())
                last = result["curve"][-1]
                console.print(f"{name}, {key}: {last['rms_percent']:.3f} %")
    if arguments.no_tables:
        return
    for name, found in results().items():
        picture(name, found)
    text = tables()
    (RESULTS.parent / "steps.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
