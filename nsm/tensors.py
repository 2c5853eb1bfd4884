"""What kind of tensors an operation was given."""

from __future__ import annotations

import torch
from torch import Tensor


def transformed() -> bool:
    """Whether a transform of torch.func is active.

    The operations with a backward pass of their own then give way to plain ones, which all
    transforms know.
    """
    return not torch.compiler.is_compiling() and torch._C._are_functorch_transforms_active()


def suit_compiled(*tensors: Tensor) -> bool:
    """Whether functions that :func:`nsm.compiled.compiled` makes take these: real tensors on the
    CPU, in single or double precision, outside all transforms."""
    if torch.compiler.is_compiling() or transformed():
        return False
    known = torch.float32, torch.float64
    return all(t.device.type == "cpu" and t.dtype in known for t in tensors)
