"""Evaluations made faster by torch.compile, where there is a compiler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Evaluation = Callable[[Tensor], tuple[Tensor, ...]]


class Compiled:
    """Calls functions in their compiled form, which is made at the first call of each.

    On a GPU the whole of a call is recorded and played back (CUDA graphs), so that small networks
    do not wait for their many operations to be started one by one. A function that cannot be
    compiled, or a machine without a compiler, is no error: the function is called as it is.

    Args:
        say: called with one line on why a function was left as it is.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self._made: dict[str, Evaluation] = {}

    def __call__(self, function: Evaluation, x: Tensor) -> tuple[Tensor, ...]:
        """``function(x)``; functions of the same name count as the same."""
        name = function.__qualname__
        if name in self._made:
            return self._made[name](x)
        mode = "reduce-overhead" if x.is_cuda else None
        # one shape of batches: code for any would be slower
        made: Any = torch.compile(function, dynamic=False, mode=mode)
        try:
            result: tuple[Tensor, ...] = made(x)
        except Exception as error:  # of any kind; an error in the function itself is raised again
            result, made = function(x), function
            reason = " ".join(str(error).split())[:120]
            self.say(f"not compiled, training continues without: {reason}")
        self._made[name] = made
        return result
