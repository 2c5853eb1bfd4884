"""Checkpoints of runs: read safely, and brought to the form of this version."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from nsm.errors import NsmError
from nsm.results.files import check_stored

CHECKPOINT_FILE = "last.ckpt"

# names of older versions and what they are now: parts of the keys of weights, callbacks, and
# entries of the checkpoint
_WEIGHTS = {"readout": "linear_skip", "weakest": "fold_barrier"}
_CALLBACKS = {"Faults": "DivergenceGuard"}
_ENTRIES = {"nsm_parts": "microbatches"}


def stored_state(checkpoint: Path) -> dict[str, Any]:
    """What a checkpoint holds, in the form of this version; its ``global_step`` is a number.

    A file of an older version is replaced by one of this version.

    Raises:
        NsmError: a file that is damaged, foreign, or that would call code or take more memory than
            its size.
    """
    try:
        check_stored(checkpoint)
        state: dict[str, Any] = torch.load(checkpoint, weights_only=True, map_location="cpu")
        state["global_step"] = int(state["global_step"])
        if _lift(state):
            temporary = checkpoint.with_suffix(".tmp")
            torch.save(state, temporary)
            temporary.replace(checkpoint)
        return state
    except Exception as error:  # whatever a damaged or foreign file raises
        raise not_a_checkpoint(checkpoint) from error


def not_a_checkpoint(file: Path) -> NsmError:
    """The error for a file that a training cannot go on from."""
    return NsmError(
        f"{file}: damaged, or not a checkpoint of this run; delete it to start again",
        kind="damaged_file",
        key=str(file),
    )


def _lift(state: dict[str, Any]) -> bool:
    """Bring a checkpoint to the form of this version; False if it has it."""
    callbacks = state.get("callbacks", {})
    old = any(old in state for old in _ENTRIES) or any(old in callbacks for old in _CALLBACKS)
    if not old:
        return False
    for before, after in _ENTRIES.items():
        if before in state:
            state[after] = state.pop(before)
    for before, after in _CALLBACKS.items():
        if before in callbacks:
            callbacks[after] = callbacks.pop(before)
    state["state_dict"] = _renamed(state["state_dict"])
    good = callbacks.get("DivergenceGuard", {}).get("good")
    if good is not None:
        good["module"] = _renamed(good["module"])
    return True


def _renamed(weights: dict[str, Any]) -> dict[str, Any]:
    return {
        ".".join(_WEIGHTS.get(part, part) for part in key.split(".")): value
        for key, value in weights.items()
    }
