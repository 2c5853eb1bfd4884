"""Batches that do not fit into memory, in parts."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.utils.checkpoint import checkpoint

from nsm.errors import NsmError

_MOST = 256
_SIGNS = ("out of memory", "not enough memory", "can't allocate memory", "alloc_failed")


def out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, on any device."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    text = str(error).lower()
    return isinstance(error, RuntimeError) and any(sign in text for sign in _SIGNS)


class Microbatching(pl.LightningModule):
    """Base of the tasks: a step that runs out of memory is tried again with its batch in halves.

    Networks are evaluated part by part, and once more for each part's gradient, so that only one
    part's intermediate values are in memory at a time. Gradients accumulate over the parts; the
    loss is that of the whole batch, also where it is no sum over points.

    Attributes:
        microbatches: the number of parts that a batch is evaluated in; kept in the checkpoint, so
            that a resumed training goes on the same way.
    """

    microbatches: int = 1

    def pointwise(
        self, function: Callable[[Tensor], tuple[Tensor, ...]], x: Tensor
    ) -> tuple[Tensor, ...]:
        """``function(x)``, evaluated on ``microbatches`` parts of x (N, ...).

        Args:
            function: from x to tensors (N, ...), each row of which depends on that row of x alone.
            x: (N, ...).
        """
        if self.microbatches == 1:
            return function(x)
        results = [
            checkpoint(function, part, use_reentrant=False)
            for part in x.tensor_split(min(self.microbatches, len(x)))
        ]
        return tuple(torch.cat(same) for same in zip(*results, strict=True))

    def optimizer_step(
        self,
        epoch: int,
        batch_idx: int,
        optimizer: Any,
        optimizer_closure: Callable[[], Any] | None = None,
    ) -> None:
        """Lightning's step, repeated in smaller parts while memory runs out.

        Raises:
            NsmError: even parts of a few points do not fit, or not the optimizer's own state.
        """
        assert optimizer_closure is not None
        while not self._stepped(epoch, batch_idx, optimizer, optimizer_closure):
            if self.microbatches >= _MOST:
                raise NsmError(
                    f"out of memory, even with a batch in {self.microbatches} parts; lower "
                    "data.batch_size or map.width",
                    kind="out_of_memory",
                    key="data.batch_size",
                )
            self.microbatches *= 2
            gc.collect()
            if torch.cuda.is_available():
                torch.cuda.empty_cache()

    def _stepped(
        self, epoch: int, index: int, optimizer: Optimizer, closure: Callable[[], Any]
    ) -> bool:
        """Whether a step was made; False if memory ran out before it changed anything."""
        evaluated = False

        def watched() -> Any:
            nonlocal evaluated
            result = closure()
            evaluated = True
            return result

        try:
            super().optimizer_step(epoch, index, optimizer, watched)
        except (MemoryError, RuntimeError) as error:
            if not out_of_memory(error):
                raise
            if self.trainer.world_size > 1:  # the other processes cannot be asked to try again
                raise NsmError(
                    "out of memory in one of several processes; lower data.batch_size or map.width",
                    kind="out_of_memory",
                    key="data.batch_size",
                ) from error
            if evaluated:  # some weights may have moved: trying again would move them twice
                raise NsmError(
                    "out of memory for the optimizer's own values; lower map.width or "
                    "encoding.resolutions, or choose optimizer=sgd",
                    kind="out_of_memory",
                    key="optimizer",
                ) from error
            return False
        return True

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["microbatches"] = self.microbatches

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.microbatches = int(checkpoint["microbatches"])
