"""A run leaves its caller's process as it was."""

from __future__ import annotations

import logging
import os
import random
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from hydra.core.global_hydra import GlobalHydra

# loggers whose level a run changes
_LOGGERS = ("pytorch_lightning", "lightning_fabric", "torch.multiprocessing.spawn")


@contextmanager
def process_state() -> Iterator[None]:
    """Restore, at the end, what a run changes in its process.

    That is: the random states of Python, numpy and torch, the environment, torch's threads and the
    precision of its matrix products, warning filters, the levels of Lightning's loggers, and
    Hydra's global state.
    """
    python, array = random.getstate(), np.random.get_state()
    environment, threads = dict(os.environ), torch.get_num_threads()
    precision = torch.get_float32_matmul_precision()
    levels = {name: logging.getLogger(name).level for name in _LOGGERS}
    hydra = GlobalHydra.instance().hydra
    # a GPU that was not used before has no state; asking for it would forbid forks
    devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    with warnings.catch_warnings(), torch.random.fork_rng(devices):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(array)
            for key in os.environ.keys() - environment.keys():
                del os.environ[key]
            os.environ.update(environment)
            torch.set_num_threads(threads)
            torch.set_float32_matmul_precision(precision)
            for name, level in levels.items():
                logging.getLogger(name).setLevel(level)
            GlobalHydra.instance().hydra = hydra


def quiet_lightning() -> None:
    """Silence Lightning's remarks on data loaders and hardware, which do not concern samples that
    are drawn on the device."""
    for name in _LOGGERS[:2]:
        logging.getLogger(name).setLevel(logging.WARNING)
    for name in _LOGGERS[:2]:
        warnings.filterwarnings("ignore", module=name)


@contextmanager
def matmul_precision(name: str) -> Iterator[None]:
    """Float32 matrix products in one of torch's precisions, for a training alone: results are
    measured in full precision."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(name)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
