"""Certify maps: check the whole mesh, repair flips, and say plainly where that failed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import pytorch_lightning as pl
from omegaconf import DictConfig
from rich.console import Console

from nsm.results.certificate import verdict

_SHARE = 10  # a further round has this part of the training's steps


class Certified(Protocol):
    """A result that can tell whether it is injective, and mend itself."""

    @property
    def certificate(self) -> dict[str, Any]: ...

    def repaired(self) -> Any: ...


Result = TypeVar("Result", bound=Certified)


def certified(
    config: DictConfig,
    trainer: pl.Trainer,
    module: Any,
    make: Callable[[], Result],
    console: Console,
) -> tuple[Result, dict[str, Any]]:
    """The result of a training, repaired until it is injective or all means are spent.

    What the network flips is turned back on the mesh; where that is not enough, the training goes
    on with stronger terms for a bounded number of rounds, and the mesh is mended again.

    Args:
        config: with ``certification.repair`` and ``certification.rounds``.
        trainer: that of the training, with its data.
        module: the task's module, which answers ``strengthen(steps)``.
        make: the result from the module as it stands.
        console: where the verdict goes.

    Returns:
        The result; and what metrics.json says of it: its certificate, with the counts that the
        network alone had (``before_repair``) and the rounds that it took.
    """
    settings = config.certification
    result = make()
    before = result.certificate
    rounds = 0
    while settings.repair and not result.certificate["certified"]:
        result = result.repaired()
        if result.certificate["certified"] or rounds >= settings.rounds:
            break
        rounds += 1
        console.print(f"{verdict(result.certificate)}; going on with stronger terms")
        _go_on(trainer, module, max(1, config.trainer.max_steps // _SHARE))
        result = make()
    after = result.certificate
    console.print(verdict(after) + ("" if before["certified"] else f"; before: {verdict(before)}"))
    counts = {name: n for name, n in before.items() if name != "certified"}
    return result, {**after, "before_repair": counts, "rounds": rounds}


def _go_on(trainer: pl.Trainer, module: Any, steps: int) -> None:
    module.strengthen(steps)
    more = pl.Trainer(
        accelerator=type(trainer.accelerator).name(),
        devices=1,
        max_steps=steps,
        max_epochs=-1,
        limit_val_batches=0,
        gradient_clip_val=trainer.gradient_clip_val,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
    )
    more.fit(module, datamodule=trainer.datamodule)  # type: ignore[attr-defined]
