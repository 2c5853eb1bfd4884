"""A training that is stopped in the middle."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from nsm.results.callbacks import AtomicCheckpoint


@contextmanager
def interrupted(at: int | None = None) -> Iterator[None]:
    """What is trained within is stopped right after the checkpoint of a step, or its first one."""
    written = AtomicCheckpoint.on_train_epoch_end

    def stop(self, trainer, module):
        written(self, trainer, module)
        if at is None or trainer.global_step == at:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(AtomicCheckpoint, "on_train_epoch_end", stop)
        yield
