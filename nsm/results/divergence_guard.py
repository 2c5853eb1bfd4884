"""A guard against trainings that diverge."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback
from rich.console import Console
from torch import Tensor
from torch.optim import Optimizer

from nsm.errors import NsmError
from nsm.tasks.ensemble import Ensemble, EnsembleSplit

_EVERY = 50  # steps between two states that are kept
_TRIES = 5
_SMALLER = 0.5


class DivergenceGuard(Callback):
    """Roll back a step whose loss or gradient is not finite, and go on with smaller steps.

    A state is kept in memory, and in the checkpoint, every few steps, once the loss and gradient
    there are known to be finite. The step that fails changes nothing: weights, optimizer and
    buffers return to the kept state, and all learning rates are halved. Of several trainings in one
    batch, those that fail have to be trained alone.

    Args:
        console: where each rollback is printed, in one line.

    Attributes:
        begun: whether training has begun, with the checkpoint, if any, loaded.
        rollbacks: {step, back_to} of each, for metrics.json.
    """

    def __init__(self, console: Console) -> None:
        self.console = console
        self.begun = False
        self.good: dict[str, Any] | None = None
        self.rollbacks: list[dict[str, int]] = []
        self.loss: Tensor | None = None
        self.microbatches = 1
        self.parameters: list[torch.nn.Parameter] = []

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.begun = True
        self.parameters = list(pl_module.parameters())  # to walk through them takes long

    def on_before_backward(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, loss: Tensor
    ) -> None:
        self.loss = loss.detach()

    def on_before_optimizer_step(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, optimizer: Optimizer
    ) -> None:
        gradients = [p.grad for p in self.parameters if p.grad is not None]
        finite = torch.isfinite(torch.nn.utils.get_total_norm(gradients))
        if self.loss is not None:
            finite = finite & torch.isfinite(self.loss)
        good = bool(finite)  # the one number that a device is waited for
        if trainer.strategy.reduce_boolean_decision(good):  # all processes do the same
            if self.good is None or trainer.global_step % _EVERY == 0:
                self._keep(trainer.global_step, pl_module, optimizer)
            return
        self._roll_back(trainer, pl_module, optimizer)

    def _keep(self, step: int, module: pl.LightningModule, optimizer: Optimizer) -> None:
        frozen = {name for name, p in module.named_parameters() if not p.requires_grad}
        state = module.state_dict()
        self.good = {
            "step": step,
            "module": {k: v.detach().clone() for k, v in state.items() if k not in frozen},
            "optimizer": copy.deepcopy(optimizer.state_dict()),
        }

    def _roll_back(
        self, trainer: pl.Trainer, module: pl.LightningModule, optimizer: Optimizer
    ) -> None:
        step = trainer.global_step
        _split(module, lambda p: p.grad, f"step {step}: the loss or its gradient is not finite")
        if self.good is None:
            raise NsmError(
                f"the loss or its gradient is not finite at the first step, {step}; check the "
                "weights of the energies and the numbers in the mesh",
                kind="not_finite",
            )
        if len(self.rollbacks) >= _TRIES:
            raise NsmError(
                f"the loss or its gradient is not finite at step {step}, after {_TRIES} returns to "
                "a good state with smaller steps; lower optimizer.lr, or set trainer.gradient_clip",
                kind="not_finite",
                key="optimizer.lr",
            )
        self._restore(module)
        # most schedules follow their base rates, others the optimizer's present ones
        for group in self.good["optimizer"]["param_groups"]:
            group.update({k: _SMALLER * group[k] for k in ("lr", "max_lr") if k in group})
        optimizer.load_state_dict(copy.deepcopy(self.good["optimizer"]))
        for configured in trainer.lr_scheduler_configs:
            scheduler: Any = configured.scheduler
            if hasattr(scheduler, "base_lrs"):
                scheduler.base_lrs = [_SMALLER * rate for rate in scheduler.base_lrs]
        # optimizers skip parameters without a gradient: momentum moves nothing either
        for p in module.parameters():
            p.grad = None
        self.rollbacks.append({"step": step, "back_to": self.good["step"]})
        self.console.print(
            f"step {step}: the loss or its gradient is not finite; back to the state of step "
            f"{self.good['step']}, with steps half as long ({len(self.rollbacks)} of {_TRIES})",
            soft_wrap=True,
        )

    def _restore(self, module: pl.LightningModule) -> None:
        assert self.good is not None
        module.load_state_dict(self.good["module"], strict=False)

    def on_train_batch_end(
        self,
        trainer: pl.Trainer,
        pl_module: pl.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        parts = getattr(pl_module, "microbatches", 1)
        if parts != self.microbatches:
            self.microbatches = parts
            self.console.print(
                f"step {trainer.global_step}: out of memory; batches are evaluated in {parts} parts"
            )

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Check the last update, which no further step checks, before the last checkpoint is
        written."""
        if trainer.global_step < trainer.max_steps and not trainer.should_stop:
            return
        trained = [p for p in pl_module.parameters() if p.requires_grad]
        if self.good is None or all(bool(torch.isfinite(p).all()) for p in trained):
            return
        _split(pl_module, lambda p: p if p.requires_grad else None, "the last step was not finite")
        self._restore(pl_module)
        self.rollbacks.append({"step": trainer.global_step, "back_to": self.good["step"]})
        self.console.print(f"the last step was not finite; back to step {self.good['step']}")

    def state_dict(self) -> dict[str, Any]:
        return {"good": self.good, "rollbacks": self.rollbacks, "parts": self.microbatches}

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        if self.good is not None and isinstance(pl_module, Ensemble):
            shown = pl_module.shown
            checkpoint["callbacks"][self.state_key]["good"] = {
                **self.good,
                "module": pl_module.weights_of(self.good["module"], shown),
                "optimizer": pl_module.shares.of_optimizer(self.good["optimizer"], shown),
            }

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        if not isinstance(pl_module, Ensemble):
            return
        each = [state["callbacks"][self.state_key]["good"] for state in pl_module.stored]
        joint = None
        if len({good and good["step"] for good in each}) == 1 and each[0]:
            joint = {
                **each[0],
                "module": pl_module.weights([good["module"] for good in each]),
                "optimizer": pl_module.shares.optimizer([good["optimizer"] for good in each]),
            }
        checkpoint["callbacks"][self.state_key]["good"] = joint

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.good, self.rollbacks = state_dict["good"], list(state_dict["rollbacks"])
        self.microbatches = state_dict["parts"]


def _split(
    module: pl.LightningModule, values: Callable[[Tensor], Tensor | None], reason: str
) -> None:
    """Split several trainings: those with a value that is not finite have to go on alone, or all,
    where it is not known which."""
    if not isinstance(module, Ensemble):
        return
    bad = []
    for i, one in enumerate(module.each):
        seen = [t for p in one.parameters() if (t := values(p)) is not None]
        if not all(bool(torch.isfinite(t).all()) for t in seen):
            bad.append(i)
    raise EnsembleSplit(reason, bad or range(len(module.each)))


def guard_of(trainer: pl.Trainer) -> dict[str, Any]:
    """What metrics.json says of a training's faults: rollbacks, and parts of a batch."""
    guard = next((c for c in trainer.callbacks if isinstance(c, DivergenceGuard)), None)  # type: ignore[attr-defined]
    return {
        "rollbacks": [] if guard is None else guard.rollbacks,
        "batch_parts": getattr(trainer.lightning_module, "microbatches", 1),
    }
