"""A run leaves its caller's process as it was."""

import logging
import os
import random
import warnings

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from tiny import results

import nsm
from nsm.config import conf_folder

TINY = ["data.batch_size=64", "data.held_out=64", "data.steps_per_epoch=2", "trainer.max_steps=4"]
TINY += ["encoding.resolutions=[4]", "map.width=8", "trainer.threads=1"]


def state():
    """All that a run could change in its process."""
    return {
        "python": random.getstate(),
        "numpy": [np.asarray(part).tolist() for part in np.random.get_state()],
        "torch": torch.random.get_rng_state().tolist(),
        "environment": dict(os.environ),
        "threads": torch.get_num_threads(),
        "precision": torch.get_float32_matmul_precision(),
        "filters": list(warnings.filters),
        "levels": {n: logging.getLogger(n).level for n in logging.root.manager.loggerDict},
        "handlers": list(logging.getLogger().handlers),
        "hydra": GlobalHydra.instance().hydra,
        "folder": os.getcwd(),
        "gradients": torch.is_grad_enabled(),
        "dtype": torch.get_default_dtype(),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "benchmark": torch.backends.cudnn.benchmark,
    }


def overfit(neural, folder):
    return nsm.overfit(neural[0].surface, overrides=TINY, folder=folder, progress=False)


def pair(neural, folder):
    words = [*TINY, "trainer.precision=bf16", "experiment=adam"]
    return nsm.map_pair(*neural[:2], overrides=words, folder=folder, progress=False)


def misspelt(neural, folder):
    with pytest.raises(nsm.NsmError):
        nsm.overfit(neural[0].surface, overrides=["map.block=none"], folder=folder)


@pytest.mark.parametrize("work", [overfit, pair, misspelt])
def test_nothing_is_left_changed(work, tmp_path):
    neural = results(rings=3).neural
    threads = torch.get_num_threads()
    work(neural, tmp_path / "first")  # what is imported late is imported now
    GlobalHydra.instance().clear()
    try:
        torch.set_num_threads(2)
        with initialize_config_dir(str(conf_folder()), version_base="1.3"):
            random.seed(7)
            np.random.seed(7)
            torch.manual_seed(7)
            before = state()
            work(neural, tmp_path / "second")
            after = state()
            compose("config")  # the caller's own Hydra works on
    finally:
        torch.set_num_threads(threads)
    for name, value in before.items():
        assert after[name] == value, name


def test_the_result_depends_on_the_seed_alone(tmp_path):
    surface = results(rings=3).neural[0].surface
    maps = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        phi = nsm.overfit(surface, overrides=TINY, progress=False)
        maps.append(torch.nn.utils.parameters_to_vector(phi.map.parameters()))
    assert torch.equal(*maps)
