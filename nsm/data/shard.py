"""What one of several processes takes of what all of them draw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Shard:
    """Process ``rank`` of ``count``."""

    rank: int = 0
    count: int = 1

    @classmethod
    def of(cls, trainer: Any) -> Shard:
        """That of a Lightning trainer, or of none."""
        return cls(trainer.global_rank, trainer.world_size) if trainer else cls()

    def of_rows(self, rows: Tensor) -> Tensor:
        """Every ``count``-th of the rows (N, ...), equally many for all: the last N % count rows
        are nobody's."""
        return rows[: len(rows) // self.count * self.count][self.rank :: self.count]
