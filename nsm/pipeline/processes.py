"""Trainings that several processes share, one a CPU core or GPU.

Lightning forks them off for the training alone. Everything before and after it (the lock on the
run folder, preparation, results) is done once, by the process that the user started.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback
from pytorch_lightning.loggers import Logger
from pytorch_lightning.loggers.logger import DummyLogger
from pytorch_lightning.strategies import DDPStrategy
from rich.console import Console
from torch.multiprocessing.spawn import ProcessRaisedException

from nsm.errors import NsmError


def shared_steps() -> DDPStrategy:
    """Each process takes its part of every batch; gradients are averaged.

    Buffers are the same everywhere, as each follows from the weights: they need not be sent.
    """
    # what a failed process raised is reported instead
    logging.getLogger("torch.multiprocessing.spawn").setLevel(logging.ERROR)
    return DDPStrategy(start_method="fork", broadcast_buffers=False, find_unused_parameters=False)


class Process(Callback):
    """Let the first process alone log and print.

    Args:
        console: that of the run.
        loggers: makes the loggers, which do not outlive a fork.
    """

    def __init__(self, console: Console, loggers: Callable[[], list[Logger]]) -> None:
        self.console, self.loggers = console, loggers

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        if trainer.is_global_zero:
            trainer.loggers = self.loggers()
        else:
            trainer.loggers = [DummyLogger()]  # callbacks of Lightning want one
            self.console.quiet = True


def take_over(trainer: pl.Trainer, checkpoint: Path) -> None:
    """Give the trainer of this process, which has the trained weights, the rest of the state that
    the training ended with."""
    state = torch.load(checkpoint, weights_only=True, map_location="cpu")
    trainer.fit_loop.load_state_dict(state["loops"]["fit_loop"])
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if callback.state_key in state["callbacks"]:
            callback.load_state_dict(state["callbacks"][callback.state_key])
    trainer.lightning_module.on_load_checkpoint(state)
    os.environ.pop("MASTER_PORT", None)  # the next training finds its own


def raised_by(error: ProcessRaisedException) -> BaseException:
    """What a process raised: bad input as such, though it could only send the text."""
    last = str(error).strip().splitlines()[-1]
    kind, _, message = last.partition(": ")
    return NsmError(message, kind="failed_process") if kind.endswith(NsmError.__name__) else error
