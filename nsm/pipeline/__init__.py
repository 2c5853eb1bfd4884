"""From a checked configuration to a run folder with results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nsm.errors import NsmError
from nsm.pipeline.collection_map import run_collection_map
from nsm.pipeline.common import quiet_lightning, stored_config
from nsm.pipeline.folder_lock import folder_lock
from nsm.pipeline.overfit import build_overfit, run_overfit
from nsm.pipeline.pair_map import run_pair_map
from nsm.pipeline.param import run_param

__all__ = [
    "TASKS",
    "build_overfit",
    "quiet_lightning",
    "run",
    "run_collection_map",
    "run_held",
    "run_overfit",
    "run_pair_map",
    "run_param",
]

TASKS: dict[str, Callable[..., Any]] = {
    "overfit": run_overfit,
    "param": run_param,
    "pair_map": run_pair_map,
    "collection_map": run_collection_map,
}


def run(config: DictConfig, folder: Path) -> None:
    """Run the task of a configuration in a folder, where no other run may be at work.

    With ``resume`` set, the folder's own configuration takes its place, and the training goes on
    from its checkpoint.

    Raises:
        NsmError: bad input of any kind, or another process at work in the folder.
    """
    with folder_lock(folder):
        run_held(config, folder)


def run_held(config: DictConfig, folder: Path) -> None:
    """What :func:`run` does, in a folder that its caller holds."""
    resuming = config.resume is not None
    if resuming:
        config = stored_config(folder)
    if config.task.name not in TASKS:
        raise NsmError(f"task.name={config.task.name} is not one of {', '.join(TASKS)}")
    TASKS[config.task.name](config, folder, resuming=resuming)
