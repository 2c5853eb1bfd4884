"""Maps by second-order steps beside the default: distortion against CPU seconds.

Figures that are there are kept, so that an interrupted run continues where it stopped:

    python benchmarks/newton_steps.py --meshes FOLDER [--only CASE ...] [--ways WAY ...]

All ways start from the same ready surfaces and are measured on the source mesh's own triangles.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytorch_lightning as pl
import torch
from closed_maps import FOUR, START, prepared, shapes
from maps import table
from pytorch_lightning.callbacks import Callback
from torch import Tensor

import nsm
from nsm.energies import first_fundamental_form
from nsm.energies.distortion import EPSILON
from nsm.pipeline import training
from nsm.pipeline.pair_map import PairMapTask
from nsm.tasks import PairMap
from nsm.tasks.curvature import positive_hessians
from nsm.tasks.one_mesh import Places

RESULTS = Path(__file__).parent / "results" / "newton_steps.json"
CASES = {
    "384-388": ("384", "388"),
    "393-388": ("393", "388"),
    "385-391": ("385", "391"),
    "302-314": ("302", "314"),
}
MARKS = (1, 2, 3, 4, 6, 8)  # CPU seconds of the training
_EVERY = 0.25
_SAME = 1e-6  # of singular values


class Proxies(PairMap):
    """A pair map whose curvature is that of SLIM's proxies (Rabinovich et al., 2017).

    With M = R J_h S⁻¹, RᵀR = J_ψᵀJ_ψ and SᵀS = A, the symmetric Dirichlet energy is Σ f(σ_i) in the
    singular values of M, f(σ) = σ² + 1/(σ² + ε), which is least at σ* = √(1 − ε). The proxy
    ½ tr((M − M*)ᵀ P (M − M*)) with P = U diag(f′(σ_i)/(σ_i − σ*)) Uᵀ has its gradient; its second
    derivatives by J_h are the Kronecker product of RᵀPR and A⁻¹.
    """

    def _hessians(
        self,
        places: Places,
        source: Tensor,
        jacobian: Tensor,
        metric: Callable[[Tensor], Tensor],
        folding: float,
    ) -> Tensor:
        eye = torch.eye(2, dtype=torch.float64).expand(len(jacobian), 2, 2)
        hessians = proxies(source.double(), metric(eye), jacobian.double())
        folds = self._folds_near(places, jacobian, folding)
        hessians = hessians + positive_hessians(folds, jacobian)
        return places.share.double()[:, None, None] * hessians


def proxies(source: Tensor, target: Tensor, jacobian: Tensor) -> Tensor:
    """Second derivatives (N, 4, 4) of SLIM's proxies by the entries of J_h, row by row.

    Args:
        source, target: metrics (N, 2, 2) that φ and ψ induce.
        jacobian: J_h (N, 2, 2).
    """
    tiny = 1e-9 * torch.eye(2, dtype=source.dtype)
    root = torch.linalg.cholesky(target + tiny).mT  # R
    inverse = torch.linalg.inv(source + tiny)
    m = root @ jacobian @ torch.linalg.cholesky(inverse)
    squares, u = torch.linalg.eigh(m @ m.mT)
    sigma = squares.clamp(min=0).sqrt()
    least = (1 - EPSILON) ** 0.5
    slope = 2 * sigma - 2 * sigma / (sigma**2 + EPSILON) ** 2
    # at the minimum, f″(σ*) = 2 + (6σ² − 2ε)/(σ² + ε)³ = 8 (1 − ε)
    far = (sigma - least).abs() > _SAME
    weight = torch.where(far, slope / torch.where(far, sigma - least, 1.0), 8 * (1 - EPSILON))
    p = (u * weight[:, None, :]) @ u.mT
    left = root.mT @ p @ root
    return torch.einsum("nac,nbd->nabcd", left, inverse).reshape(-1, 4, 4)


NEWTON = [
    "experiment=fast",
    "optimizer.iterations=1",  # the curvature is taken anew in each
    "optimizer.steps=[15,15,15,15]",
    "trainer.max_steps=75",
    "data.steps_per_epoch=25",
]
BEFORE = [  # the default's steps before these trials
    "trainer.max_steps=306",
    "constraints.triangles_from=0.98",
    "optimizer.iterations=15",
    "optimizer.memory=12",
    "scheduler.warmup=100",
]
WAYS: dict[str, tuple[type[PairMap], list[str]]] = {
    "default": (PairMap, []),
    "300 + 6 × 15 steps": (PairMap, BEFORE),
    "fast": (PairMap, ["experiment=fast"]),
    "projected Newton": (PairMap, NEWTON),
    "SLIM": (Proxies, NEWTON),
    "L-BFGS from SLIM's proxies": (Proxies, ["experiment=fast"]),
}


class Watch(Callback):
    """The map on the mesh's triangles against CPU seconds, which this does not count for."""

    def __init__(self) -> None:
        self.started = self.aside = self.due = 0.0
        self.course: list[dict[str, float]] = []

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.started = time.process_time()

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any
    ) -> None:
        before = time.process_time()
        spent = before - self.started - self.aside
        if spent >= self.due or trainer.global_step == trainer.max_steps:
            self.due = spent + _EVERY
            self.course.append({"seconds": round(spent, 2), **measured(pl_module)})
        self.aside += time.process_time() - before


@torch.no_grad()
def measured(module: Any) -> dict[str, float]:
    """Mean distortion on the mesh's triangles, and the largest landmark error in percent."""
    some = module.quadrature.take()
    h = module.map(some.uv)
    metric = first_fundamental_form(some.sides(module.psi(h)))
    distortion, _ = module._on_triangles(some, h, some.sides(h), metric)
    missed = float(module.landmark_error().max())
    return {"mean": round(float(distortion.mean), 4), "missed": round(missed, 4)}


def run(source: Any, target: Any, landmarks: Any, way: str) -> dict[str, Any]:
    """The course of a training, and the figures of its map."""
    kind, settings = WAYS[way]
    watch = Watch()
    with (
        patch.object(PairMapTask, "module", kind),
        patch.object(training, "_own_callbacks", lambda config: [watch]),
    ):
        f = nsm.map_pair(
            source, target, landmarks, overrides=[*settings, "artefacts=false"], progress=False
        )
    keys = ("median", "mean", "p95")
    figures = {key: f.metrics[f"symmetric_dirichlet_{key}"] for key in keys}
    others = ("flipped_before_repair_percent", "landmark_error_max_percent")
    return {"course": watch.course, **figures, **{key: f.metrics[key] for key in others}}


def ready(meshes: Path, case: str) -> tuple[Any, Any, Any]:
    """The surfaces of a case, as ``closed_maps.py`` prepares them, and their landmarks."""
    numbers = CASES[case]
    if set(numbers) <= set(FOUR):
        files, marks = shapes(meshes, FOUR, "vts")
        surfaces, points = prepared(tuple(files), tuple(marks), "orbifold")
        i, j = (FOUR.index(number) for number in numbers)
        return surfaces[i], surfaces[j], points[:, [i, j]].tolist()
    files, marks = shapes(meshes, numbers, "vts")
    start = nsm.map_pair(*files, marks, overrides=START, progress=False)
    return start.source, start.target, start.landmarks.tolist()


def at(course: Sequence[dict[str, float]], seconds: float) -> str:
    """The mean after so many seconds, if the training lasted so long."""
    before = [step for step in course if step["seconds"] <= seconds]
    if not before or course[-1]["seconds"] < seconds:
        return "–"
    return f"{before[-1]['mean']:.2f}"


def tables(found: dict[str, Any]) -> str:
    """The results as Markdown."""
    rows = []
    for case, ways in found.items():
        for way, of in sorted(ways.items(), key=lambda one: list(WAYS).index(one[0])):
            name = "" if rows and rows[-1][-1] == case else case
            figures = [f"{of[key]:.2f}" for key in ("median", "mean", "p95")]
            flips = f"{of['flipped_before_repair_percent']:.3f}"
            missed = f"{of['landmark_error_max_percent']:.3f}"
            course = [at(of["course"], mark) for mark in MARKS]
            seconds = f"{of['course'][-1]['seconds']:.1f}"
            rows.append([name, way, *course, seconds, *figures, flips, missed, case])
    heads = ["map", "training", *(f"{mark} s" for mark in MARKS), "seconds"]
    heads += ["median", "mean", "95th percentile", "folded %", "landmark error %"]
    return table(heads, [row[:-1] for row in rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    parser.add_argument("--only", nargs="*", default=list(CASES), help="cases to run")
    parser.add_argument("--ways", nargs="*", default=list(WAYS), help="trainings to run")
    arguments = parser.parse_args()
    if not arguments.meshes.is_dir():
        parser.error(f"{arguments.meshes}: no such folder; give one with --meshes")
    torch.set_num_threads(1)
    found = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for case in arguments.only:
        ways = [way for way in arguments.ways if way not in found.setdefault(case, {})]
        if ways:
            ends = ready(arguments.meshes, case)
        for way in ways:
            print(case, way, flush=True)
            found[case][way] = run(*ends, way)
            RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    text = tables(found)
    RESULTS.with_suffix(".md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
