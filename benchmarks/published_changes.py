"""Why the map of the published recipe ends as it does: one setting changed at a time.

The map of published.py's reduced form is trained again, on its surfaces, with one change in each
training and fewer steps; the schedule is stretched to them, as it always is. Of each map the table
has the figures at its end, and the share that each term has in the gradient.

    python benchmarks/published_changes.py [--meshes FOLDER] [--only CHANGE ...]

published.py comes first: it trains the surfaces. What is in the result file is not repeated.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from maps import table
from published import FORMS, NAMES, QUIET, RESULTS, Store, animals
from rich.console import Console
from training import samples_of, train

import nsm
from nsm.config import compose_config
from nsm.domains import Surface
from nsm.pipeline import built, make_task, quiet_lightning
from nsm.results import NeuralSurface, overfit_metrics
from nsm.surfaces.cache import cache_folder

FILE = RESULTS / "published_changes.json"
STEPS = 2000
ACCURATE = "φ and ψ as the default fits them"
# overrides beside experiment=paper; the surfaces are those of the reduced form but for one row
CHANGES: dict[str, list[str]] = {
    "none": [],
    "λ_C = 0 (1e3)": ["loss_weights.landmarks=0"],
    "λ_C = 1e6": ["loss_weights.landmarks=1e6"],
    "λ_B = 1e4 (1e6)": ["loss_weights.boundary=1e4"],
    "boundary by construction": ["constraints.boundary=exact"],
    "λ_inv = 1e4 (1e2)": ["loss_weights.injectivity=1e4"],
    "learning rate 1e-5 (1e-4)": ["optimizer.lr=1e-5"],
    # there B is the sum of (‖x‖² − 1)², nearly four times the squared distance, over the vertices
    # of the boundary, some 250
    "the authors' code: λ_C = 1e6, λ_B = 1e7, no momentum": [
        "loss_weights.landmarks=1e6",
        "loss_weights.boundary=1e7",
        "optimizer.momentum=0",
    ],
    ACCURATE: [],
}
COLUMNS = {
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_mean": "mean",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_percent": "flipped %, nothing repaired",
    "outside_percent": "outside %",
    "landmark_error_mean_percent": "landmark error, mean",
    "landmark_error_max_percent": "largest",
}
TERMS = ("distortion_symmetric_dirichlet", "injectivity", "boundary", "landmarks")


def shares(module: Any, config: Any, surface: Surface) -> dict[str, float]:
    """The norm of each term's gradient in the weights of h, at one batch of the training."""
    data = samples_of(config, surface)
    data.setup()
    data.setup()
    batch = data.batch(0)
    told: dict[str, Any] = {}
    module.train()
    module.log_terms = lambda loss, terms, **_: told.update(terms)
    module.training_step(batch, 0)
    weights = [p for p in module.map.parameters() if p.requires_grad]
    found = {}
    for name, (weight, value) in told.items():
        if isinstance(value, torch.Tensor) and value.requires_grad:
            parts = torch.autograd.grad(
                weight * value, weights, retain_graph=True, allow_unused=True
            )
            found[name] = float(sum((g**2).sum() for g in parts if g is not None) ** 0.5)
    return found


def changed(
    phis: Sequence[Any], landmarks: Sequence[np.ndarray], overrides: Sequence[str]
) -> dict[str, Any]:
    """A training with changed settings: its seconds, figures before and after, and gradients."""
    settings = ["task=pair_map", "experiment=paper", *QUIET, f"trainer.max_steps={STEPS}"]
    config = compose_config([*settings, *overrides])
    task: Any = make_task(config, Console(quiet=True))
    task.use(*phis, landmarks)

    def figures(module: Any) -> dict[str, float]:
        task.trained = result = task.make_result(module)
        task.measure(result)
        return dict(result.metrics)

    start = figures(built(task))
    began = time.process_time()
    inputs = (*phis, landmarks)
    trainer, module, _ = train(config, phis[0].surface, [], inputs=inputs)
    return {
        "seconds": time.process_time() - began,
        "steps": trainer.global_step,
        "start": start,
        "metrics": figures(module),
        "gradients": shares(module, config, phis[0].surface),
    }


def fitted(phi: Any) -> Any:
    """The surface that the default's training starts from, on the cut of another."""
    surface = phi.surface
    _, module, _ = train(compose_config(["domain=disc", "trainer.max_steps=1"]), surface, [])
    network = module.map.eval().requires_grad_(False)
    return NeuralSurface(surface, network, overfit_metrics(surface, network), {})


def tables(file: Path) -> str:
    """The result file as Markdown."""
    found = json.loads(file.read_text())
    first = found["none"]

    def cells(metrics: dict[str, float]) -> list[str]:
        return [f"{metrics[key]:.3f}" if key in metrics else "–" for key in COLUMNS]

    rows = [["as h starts", "0", *cells(first["start"]), *["–"] * len(TERMS)]]
    for name in CHANGES:
        if name not in found:
            continue
        entry = found[name]
        pulls = [f"{entry['gradients'].get(key, 0.0):.2g}" for key in TERMS]
        rows.append([name, str(entry["steps"]), *cells(entry["metrics"]), *pulls])
    heads = ["change", "steps", *COLUMNS.values(), "gradient: distortion", "G", "B", "C"]
    return table(heads, rows) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, help="folder with the mesh files; else fetched")
    parser.add_argument("--only", nargs="*", help="changes to train; all by default")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quiet_lightning()
    kept = cache_folder() / "published" / "published-reduced"
    if not kept.is_dir():
        parser.error("train the surfaces first: benchmarks/published.py")
    _, _, landmarks = animals(arguments.meshes)
    phis = [nsm.load(kept / name) for name in NAMES]
    store = Store(FILE, FORMS["reduced"])
    for name, overrides in CHANGES.items():
        if name in store or (arguments.only and name not in arguments.only):
            continue
        used = [fitted(phi) for phi in phis] if name == ACCURATE else phis
        errors = [phi.metrics["rms_percent"] for phi in used]
        store.put(name, {**changed(used, landmarks, overrides), "surfaces_rms_percent": errors})
    text = tables(FILE)
    FILE.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
