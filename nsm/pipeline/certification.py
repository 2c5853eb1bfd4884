"""Certify maps: check the whole mesh, repair flips, and train on where that is not enough."""

from __future__ import annotations

import math
from typing import Any

import pytorch_lightning as pl

from nsm.errors import NsmError
from nsm.pipeline.process_state import matmul_precision
from nsm.pipeline.task import Task
from nsm.pipeline.training import lightning_trainer
from nsm.results.certificate import verdict
from nsm.results.divergence_guard import DivergenceGuard
from nsm.results.progress import TrainingProgress
from nsm.settings import PRECISIONS
from nsm.wording import number_of

_SHARE = 10  # a further training has this part of the training's steps
_OVERLAPS = "boundary_self_intersections"  # of a free boundary


def certified(task: Task, module: Any, data: pl.LightningDataModule) -> tuple[Any, dict[str, Any]]:
    """The best result of a training, repaired until it is injective or all means are spent.

    Triangles that the network flips are turned back on the mesh; where that is not enough, the
    training goes on with stronger terms for a bounded number of rounds, and the mesh is repaired
    again, as long as that leaves fewer faults than before. The result with the fewest faults is
    returned, the first of equal ones. A free boundary that overlaps itself is reported: a
    further training does not undo that.

    Args:
        task: with ``certification.repair`` and ``certification.rounds`` in its settings.
        module: the trained module, which has ``strengthen(steps)``.
        data: its samples.

    Returns:
        The result; and its entries in metrics.json: its certificate, the counts of the network
        alone (``before_repair``), and the number of further trainings (``rounds``).
    """
    settings, say = task.config.certification, task.console.print
    task.trained = best = result = task.make_result(module)
    before, what = result.certificate, getattr(result, "statement", "injective")
    rounds = 0
    least = math.inf
    while settings.repair and not best.certificate["certified"]:
        result = result.repaired()
        best = min(best, result, key=_faults)
        if not _trainable(best) or rounds >= settings.rounds:
            break
        if _faults(best) >= least:
            said = verdict(best.certificate, what)
            say(f"{said}, as before: no further training", soft_wrap=True)
            break
        least = _faults(best)
        rounds += 1
        say(
            f"{verdict(best.certificate, what)}; going on with stronger terms, "
            f"{rounds} of {number_of(settings.rounds, 'time')} at most",
            soft_wrap=True,
        )
        try:
            _train_on(task, module, data)
        except NsmError as error:  # the loss stays infinite
            say(f"{error}; the best result so far is kept", soft_wrap=True)
            break
        result = task.make_result(module)
        best = min(best, result, key=_faults)
    after = best.certificate
    earlier = "" if before["certified"] else f"; before repair: {verdict(before, what)}"
    say(verdict(after, what) + earlier, soft_wrap=True)
    if after.get(_OVERLAPS):
        say("the free boundary overlaps itself; constraints.boundary=fixed rules that out")
    counts = {name: n for name, n in before.items() if name != "certified"}
    return best, {**after, "before_repair": counts, "rounds": rounds}


def _faults(result: Any) -> int:
    """How many faults the certificate counts."""
    return sum(int(n) for name, n in result.certificate.items() if name != "certified")


def _trainable(result: Any) -> bool:
    """Whether the certificate counts faults that a further training acts on."""
    skipped = ("certified", _OVERLAPS)
    return any(n for name, n in result.certificate.items() if name not in skipped)


def _train_on(task: Task, module: Any, data: pl.LightningDataModule) -> None:
    config = task.config
    steps = max(1, config.trainer.max_steps // _SHARE)
    module.strengthen(steps)
    guard = DivergenceGuard(task.console)
    how = module.progress_figure, module.progress_form
    progress = TrainingProgress(task.console, "stronger terms", *how)
    trainer = lightning_trainer(
        config, [guard, progress], devices=1, max_steps=steps, limit_val_batches=0
    )
    with matmul_precision(PRECISIONS[config.trainer.precision]):
        trainer.fit(module, datamodule=data)
