"""What all tasks share: figures of the training, taken where they are wanted."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from nsm.tasks.compiling import Compiled
from nsm.tasks.microbatching import Microbatching
from nsm.tasks.terms import Term


class Training(Microbatching):
    """Base of the tasks.

    Attributes:
        log_every: steps between two values that the logger takes; in the steps between, Lightning
            would spend as long on figures as the network on its work.
        compiled: calls evaluations of a training step in a compiled form; None: as they are.
    """

    log_every = 1
    compiled: Compiled | None = None

    def pointwise(
        self, function: Callable[[Tensor], tuple[Tensor, ...]], x: Tensor
    ) -> tuple[Tensor, ...]:
        # held-out batches have other shapes, and parts of a batch are checkpointed
        if self.compiled is not None and self.training and self.microbatches == 1:
            return self.compiled(function, x)
        return super().pointwise(function, x)

    def note(self, figures: Mapping[str, Tensor], kind: str = "train") -> None:
        """Log figures of a training step as ``KIND/NAME``, in the steps that the logger takes."""
        if (self.global_step + 1) % self.log_every == 0:
            self.logged({f"{kind}/{name}": value for name, value in figures.items()})

    def logged(self, figures: Mapping[str, Tensor], batch_size: int | None = None) -> None:
        """Log figures as they are called; means over batches weigh each by its size."""
        self.log_dict(dict(figures), batch_size=batch_size)

    def summed(self, terms: Mapping[str, Term]) -> Tensor:
        """The loss Σ λ·term, logged with its terms.

        Each term goes to the log as it is, ``train/NAME``, and times its λ, ``weighted/NAME``; the
        latter add up to ``train/loss``.

        Args:
            terms: by name, λ and the term, a scalar, or (k,) of trainings in one batch, as is the
                loss then.
        """
        parts = {name: weight * value for name, (weight, value) in terms.items()}
        first, *rest = parts.values()
        loss = sum(rest, start=first)
        self.note({**{name: value for name, (_, value) in terms.items()}, "loss": loss})
        self.note(parts, "weighted")
        return loss
