"""What is computed at points, kept for when they come again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


class AtPoints:
    """Results at the sets of points that were asked for last.

    Args:
        most: points of all sets together; the sets that were not asked for longest are dropped.
    """

    def __init__(self, most: int) -> None:
        self.most, self.count = most, 0
        self._known: dict[Hashable, tuple[Tensor, Any]] = {}

    def __len__(self) -> int:
        return len(self._known)

    def get(self, x: Tensor, compute: Callable[[], T], kind: Hashable = None) -> T:
        """What is known at points (N, 2), or else ``compute()``, which is kept.

        Args:
            x: the points.
            compute: of them, without a gradient.
            kind: of the result.
        """
        if x.is_meta:  # a sketch without values
            return compute()
        on_cpu = x.device.type == "cpu"
        # to look at values, a device would have to be waited for: there it is the tensor itself
        # that comes again, as it was
        version = None if x.is_inference() else x._version
        values = x[:1].flatten().tolist() if on_cpu else (id(x), version)
        key = (kind, x.device, x.dtype, len(x), *values)
        known = self._drop(key)
        if known is None or on_cpu and not torch.equal(known[0], x):
            # what a validation computes must serve the training too
            with torch.inference_mode(False), torch.no_grad():
                known = x.clone() if on_cpu else x, compute()
        self._known[key] = known
        self.count += len(x)
        while self.count > self.most:
            self._drop(next(iter(self._known)))
        result: T = known[1]
        return result

    def _drop(self, key: Hashable) -> tuple[Tensor, Any] | None:
        known = self._known.pop(key, None)
        self.count -= 0 if known is None else len(known[0])
        return known

    def __getstate__(self) -> dict[str, Any]:
        return {"most": self.most, "count": 0, "_known": {}}
