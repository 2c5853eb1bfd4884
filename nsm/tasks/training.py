"""What all tasks share: the logged figures, compiled evaluation, the optimizer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

from torch import Tensor, nn

from nsm.tasks.compiling import Compiled
from nsm.tasks.curvature import Curvature
from nsm.tasks.microbatching import Microbatching
from nsm.tasks.optimizers import configure
from nsm.tasks.quasi_newton import QuasiNewton
from nsm.tasks.terms import Term


class Training(Microbatching):
    """Base of the tasks' modules, which train ``self.map``.

    Attributes:
        Weights: the dataclass of the task's ``loss_weights``.
        Constraints: the dataclass of its ``constraints``; None: it has none.
        progress_figure, progress_form: the logged figure beside the progress bar, and its format.
        log_every: steps between two logged values; logging each step would take Lightning as long
            as the network takes for its work.
        batch: of the last evaluation of a training step.
        figures: of that evaluation, if they are to be logged.
        compiled: calls evaluations of a training step in compiled form; None: uncompiled.
    """

    Weights: ClassVar[type]
    Constraints: ClassVar[type | None] = None
    progress_figure, progress_form = "val/distortion", "distortion {:.3f}"
    map: Any
    loss_terms: Any  # ModuleDict of nsm.tasks.terms.LossTerm
    log_every = 1
    compiled: Compiled | None = None
    batch: Any = None
    figures: Mapping[str, Tensor] | None = None

    @property
    def may_end_early(self) -> bool:
        """Whether the steps to come end where they no longer gain much."""
        return self.quasi_newton is not None and self.quasi_newton.on_last_level

    @property
    def quasi_newton(self) -> QuasiNewton | None:
        """The optimizer, if it is one of quasi-Newton steps."""
        optimizer = self.trainer.optimizers[0]
        return optimizer if isinstance(optimizer, QuasiNewton) else None

    def pointwise(
        self, function: Callable[[Tensor], tuple[Tensor, ...]], x: Tensor
    ) -> tuple[Tensor, ...]:
        # held-out batches have other shapes, and parts of a batch are checkpointed
        if self.compiled is not None and self.training and self.microbatches == 1:
            return self.compiled(function, x)
        return super().pointwise(function, x)

    def log_terms(self, loss: Tensor, terms: Mapping[str, Term], **figures: Tensor) -> None:
        """Take the figures of a training step, in the steps that the logger takes.

        They are logged at the step's end: a quasi-Newton step evaluates the loss many times. Each
        term is logged as it is, ``train/NAME``, and times its weight, ``weighted/NAME``; the
        latter add up to ``train/loss``.

        Args:
            loss: a scalar, or (k,) of k trainings in one batch, as are the terms.
            terms: by name, weight and value; those that are 0.0 are absent, and not logged.
            figures: further ones, logged as ``train/NAME``.
        """
        if (self.global_step + 1) % self.log_every:
            return
        there = {name: pair for name, pair in terms.items() if isinstance(pair[1], Tensor)}
        values = {name: value for name, (_, value) in there.items()}
        found = {
            **{f"train/{name}": v for name, v in {**figures, **values, "loss": loss}.items()},
            **{f"weighted/{name}": weight * value for name, (weight, value) in there.items()},
        }
        self.figures = {k: v.detach() for k, v in found.items() if isinstance(v, Tensor)}

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        if self.figures is not None:
            self.log_figures(self.figures)
        self.figures = None

    def on_train_end(self) -> None:
        if self.quasi_newton is not None:
            self.quasi_newton.release()

    def log_figures(self, figures: Mapping[str, Any], batch_size: int | None = None) -> None:
        """Log figures under their names; means over batches weigh each by its size."""
        self.log_dict(dict(figures), batch_size=batch_size)

    def configure_optimizers(self) -> Any:
        configured = configure(self.map, self.hparams)
        if isinstance(configured["optimizer"], QuasiNewton):
            configured["optimizer"].watch(self.curvatures, self.turns)
        return configured

    def curvatures(self) -> Sequence[Curvature]:
        """The curvature of the loss of the last training step by each planar map, for quasi-Newton
        steps; terms that say nothing of theirs are left out."""
        return []

    def turns(self) -> Iterable[nn.Module]:
        """What a quasi-Newton step moves, one part after the other while the rest is held."""
        return [self.map]
