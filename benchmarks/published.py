"""Whole trainings by the published recipe, each to its own stop, beside the default settings.

Two animals are overfitted and one is mapped to the other over the disc, with experiment=paper and
with the default. The published recipe takes days on a CPU, so that what is trained there is a
reduced form, with narrower and fewer layers of φ and fewer steps, as ``FORMS`` says and the result
states; --form full is for a GPU. It is measured after a time in which the default is long done, and
where it stops itself.
The recipe cuts each animal by itself, the default of the map both together.

    python benchmarks/published.py [--meshes FOLDER] [--form full]

Seconds are the CPU time of one thread, or the time on the GPU. What is in the result file is not
repeated.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from training import Clock, train

import nsm
from nsm.config import compose_config
from nsm.domains import Surface
from nsm.domains.joint_preparation import prepare_jointly
from nsm.domains.names import DOMAINS
from nsm.pipeline import built, make_task, quiet_lightning
from nsm.pipeline.landmark_inputs import landmark_vertices
from nsm.pipeline.resolve_inputs import read_shape
from nsm.results import NeuralSurface, atomic_write, overfit_metrics
from nsm.results.callbacks import GradientWatch
from nsm.surfaces.cache import cache_folder

RESULTS = Path(__file__).parent / "results"
NAMES = ("shrec07-384", "shrec07-388")


@dataclass(frozen=True)
class Form:
    """How much of the published recipe is trained.

    Attributes:
        label: of the tables.
        surface, pair: overrides beside experiment=paper.
        early: seconds after which a surface and the map are measured on the way.
        for_gpu: whether all is trained on the GPU where there is one.
    """

    label: str
    surface: tuple[str, ...] = ()
    pair: tuple[str, ...] = ()
    early: tuple[float, float] = (16.0, 47.0)
    for_gpu: bool = False

    @property
    def accelerator(self) -> str:
        """Lightning's word for the hardware."""
        return "gpu" if self.for_gpu and torch.cuda.is_available() else "cpu"

    @property
    def machine(self) -> str:
        """What the seconds are of: the card's name, or one thread."""
        if self.accelerator == "gpu":
            return str(torch.cuda.get_device_name())
        return "one thread of a CPU"

    def seconds(self) -> float:
        """CPU time of the process; on a GPU, time."""
        if self.accelerator == "gpu":
            torch.cuda.synchronize()
            return time.perf_counter()
        return time.process_time()


FORMS = {
    "full": Form("published recipe", for_gpu=True),
    "reduced": Form(
        "published recipe, reduced: φ and ψ of 4 blocks of 32 for 6,000 steps each, h of 4 layers "
        "of 128 for 4,000 steps",
        ("map.width=32", "map.depth=4", "trainer.max_steps=6000"),
        ("trainer.max_steps=4000",),
    ),
}
QUIET = ["logger=none", "artefacts=false", "trainer.progress=false", "domain=disc"]


class Store:
    """The result file, written after each entry."""

    def __init__(self, file: Path, form: Form) -> None:
        self.file = file
        self.found: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
        self.found |= {"form": form.label, "machine": form.machine, "torch": torch.__version__}

    def __contains__(self, key: str) -> bool:
        return key in self.found

    def put(self, key: str, value: dict[str, Any]) -> None:
        self.found[key] = value
        atomic_write(self.file, (json.dumps(self.found, indent=1) + "\n").encode())
        print(key, value.get("seconds"), flush=True)


def trained(
    config: Any, inputs: tuple[Any, ...], surface: Surface, when: float, measured: Any, form: Form
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Train by the published recipe to its own stop.

    Args:
        config: of the training.
        inputs: what its task takes.
        surface: of the samples.
        when: seconds after which it is measured for the first time.
        measured: from the module to its figures.
        form: of the recipe.

    Returns:
        The module, its entry after those seconds, and that at its stop.
    """
    early: dict[str, Any] = {}

    def at_mark(module: Any, spent: float, step: int) -> None:
        place = module.device
        early.update(seconds=spent, steps=step, metrics=measured(module.cpu()))
        module.to(place).train()

    settings = config.trainer
    watch = GradientWatch.of(settings)
    clock = Clock([when, math.inf], at_mark, form.seconds)
    trainer, module, _ = train(
        config, surface, [clock, watch], inputs=inputs, accelerator=form.accelerator
    )
    stop = {
        "seconds": clock.spent,
        "steps": trainer.global_step,
        "stopped_by": "max_steps" if trainer.global_step >= settings.max_steps else "gradient norm",
        "gradient_norm_of_the_sum": _norm(watch, config, surface),
        "metrics": measured(module),
    }
    return module, early or stop, stop


def _norm(watch: GradientWatch, config: Any, surface: Surface) -> float:
    """The mean norm of the last steps' gradients that the stopping rule compares."""
    samples = config.data.batch_size + len(surface.vertices) * config.sampler.every_vertex
    return samples * sum(watch.recent) / max(1, len(watch.recent))


def animals(folder: Path | None) -> tuple[list[str], list[Any], list[np.ndarray]]:
    """The files of the two animals, or their names in the catalogue if there is no folder, their
    meshes, and the landmarks as vertices of each."""
    files = marks = list(NAMES)
    if folder is not None:
        files = [str(folder / f"{name}.off") for name in NAMES]
        marks = [str(folder / "landmarks" / f"{name}.vts") for name in NAMES]
    meshes: list[Any] = [read_shape(file, DOMAINS["disc"], file) for file in files]
    return files, meshes, list(landmark_vertices(marks, meshes))


def overfitted(store: Store, surface: Surface, form: Form, folder: Path) -> Any:
    """The neural surface of an animal by the published recipe, with its figures and those of the
    default on the same cut."""
    name = surface.name
    place = folder / name

    def figures(module: Any) -> dict[str, float]:
        return overfit_metrics(surface, module.map.eval())

    if f"{name}/default" not in store:
        start = form.seconds()
        config = compose_config(["domain=disc"])
        trainer, module, _ = train(config, surface, [], accelerator=form.accelerator)
        entry = {"seconds": form.seconds() - start, "steps": trainer.global_step}
        store.put(f"{name}/default", {**entry, "metrics": figures(module)})
    if f"{name}/published" not in store or not place.exists():
        config = compose_config(["experiment=paper", *form.surface])
        module, early, stop = trained(config, (surface,), surface, form.early[0], figures, form)
        phi = NeuralSurface(surface, module.map.eval().requires_grad_(False), stop["metrics"], {})
        phi.save(place)
        store.put(f"{name}/published, on the way", early)
        store.put(f"{name}/published", stop)
    return nsm.load(place)


def mapped(
    store: Store, phis: list[Any], landmarks: Sequence[np.ndarray], files: list[str], form: Form
) -> None:
    """The map by default and by the published recipe, the latter before and after its training.

    Args:
        store: where it is put.
        phis: neural surfaces of source and target by the recipe.
        landmarks: vertices (L,) of each one's mesh file.
        files: the meshes.
        form: of the recipe.
    """
    pair = " → ".join(phi.surface.name for phi in phis)
    if f"{pair}/default" not in store:
        pairs = np.stack(landmarks, axis=1).tolist()
        place = f"trainer.accelerator={form.accelerator}"
        first = [place, "domain=disc", "trainer.max_steps=1", "certification.rounds=0"]
        ready = nsm.map_pair(*files, pairs, overrides=first, progress=False)  # the surfaces
        start = form.seconds()
        f = nsm.map_pair(ready.source, ready.target, pairs, overrides=[place], progress=False)
        spent = form.seconds() - start
        steps = f.config["trainer"]["max_steps"]
        store.put(f"{pair}/default", {"seconds": spent, "steps": steps, "metrics": f.metrics})
    if f"{pair}/published" in store:
        return
    config = compose_config(["task=pair_map", "experiment=paper", *QUIET, *form.pair])
    task: Any = make_task(config, Console(quiet=True))
    task.use(*phis, landmarks)

    def figures(module: Any) -> dict[str, float]:
        task.trained = result = task.make_result(module)  # the recipe repairs nothing
        task.measure(result)
        return dict(result.metrics)

    store.put(f"{pair}/before", {"seconds": 0.0, "steps": 0, "metrics": figures(built(task))})
    inputs = (*phis, landmarks)
    _, early, stop = trained(config, inputs, phis[0].surface, form.early[1], figures, form)
    store.put(f"{pair}/published, on the way", early)
    store.put(f"{pair}/published", stop)


COLUMNS = {
    "rms_percent": "RMS, % of diagonal",
    "normal_error_mean_degrees": "normal error, mean",
}
MAP_COLUMNS = {
    "symmetric_dirichlet_median": "median",
    "symmetric_dirichlet_mean": "mean",
    "symmetric_dirichlet_p95": "95th percentile",
    "flipped_before_repair_percent": "flipped % before repair",
    "flipped_percent": "after",
    "outside_percent": "outside %",
    "landmark_error_max_percent": "landmark error, largest",
}


def _as_it_starts(key: str, metrics: dict[str, float], columns: dict[str, str]) -> list[str]:
    """The row of the default's map as h starts, where nothing is repaired."""
    what, _, stage = key.partition("/")
    start = {name.removeprefix("start_"): v for name, v in metrics.items() if name[:6] == "start_"}
    if stage != "default" or not start:
        return []
    start["flipped_before_repair_percent"] = start["flipped_percent"]
    cells = [f"{start[name]:.3f}" if name in start else "–" for name in columns]
    return [f"| {what}, default, as h starts | 0 | 0 | {' | '.join(cells)} |"]


def tables(file: Path) -> str:
    """The result file as Markdown."""
    found = json.loads(file.read_text())
    stages = ("default", "before", "published, on the way", "published")
    subjects = dict.fromkeys(key.partition("/")[0] for key in found if "/" in key)
    keys = [f"{subject}/{stage}" for subject in subjects for stage in stages]
    entries = {key: found[key] for key in keys if key in found}
    parts = [f"{found['form']}. Seconds of {found['machine']}."]
    for columns in (COLUMNS, MAP_COLUMNS):
        first = next(iter(columns))
        shown = {k: v for k, v in entries.items() if first in v["metrics"]}
        lines = [f"| training | seconds | steps | {' | '.join(columns.values())} |"]
        lines.append("|---" * (3 + len(columns)) + "|")
        for key, entry in shown.items():
            lines += _as_it_starts(key, entry["metrics"], columns)
            told = [entry["metrics"].get(name) for name in columns]
            figures = " | ".join("–" if one is None else f"{one:.3f}" for one in told)
            spent = f"{entry['seconds']:.0f} | {entry['steps']}"
            lines.append(f"| {key.replace('/', ', ')} | {spent} | {figures} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=Path, help="folder with the mesh files; else fetched")
    parser.add_argument("--form", default="reduced", choices=list(FORMS))
    parser.add_argument("--folder", type=Path, default=RESULTS, help="of the result file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quiet_lightning()
    form = FORMS[arguments.form]
    card = f"-{form.machine.replace(' ', '-')}" if form.accelerator == "gpu" else ""
    file = arguments.folder / f"published-{arguments.form}{card}.json"
    store, kept = Store(file, form), cache_folder() / "published" / file.stem
    files, meshes, landmarks = animals(arguments.meshes)
    surfaces = prepare_jointly(meshes, landmarks, seam="own")  # as experiment=paper does
    phis = [overfitted(store, surface, form, kept) for surface in surfaces]
    mapped(store, phis, landmarks, files, form)
    text = tables(file)
    file.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
