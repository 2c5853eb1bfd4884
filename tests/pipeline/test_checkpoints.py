"""Checkpoints of older versions."""

from functools import cache

import pytest
import torch
from interruption import interrupted
from tiny import results

import nsm
from nsm.config import compose_config
from nsm.pipeline import Given, run_task
from nsm.pipeline.checkpoints import stored_state

WORDS = ["data.batch_size=64", "data.held_out=64", "data.steps_per_epoch=5", "logger=none"]
WORDS += ["trainer.max_steps=20", "trainer.threads=1", "trainer.progress=false"]
WORDS += ["artefacts=false", "map.width=8", "map.depth=1", "encoding.resolutions=[4]"]


@cache
def surfaces():
    return results(rings=3).neural


def run(task, folder, resuming=False):
    neural = surfaces()
    given = {
        "overfit": Given(surface=neural[0].surface),
        "pair_map": Given(source=neural[0], target=neural[1], landmarks=[(0, 0), (9, 8)]),
    }[task]
    more = ["experiment=adam"] if task == "pair_map" else []
    config = compose_config([f"task={task}", *more, *WORDS])
    return run_task(config, folder, given, resuming=resuming)


def aged(state):
    """A checkpoint as version 1 wrote it."""
    new = {"linear_skip": "readout", "fold_barrier": "weakest"}

    def renamed(weights):
        return {".".join(new.get(p, p) for p in key.split(".")): v for key, v in weights.items()}

    state["nsm_parts"] = state.pop("microbatches")
    guard = state["callbacks"].pop("DivergenceGuard")
    guard["good"]["module"] = renamed(guard["good"]["module"])
    state["callbacks"]["Faults"] = guard
    state["state_dict"] = renamed(state["state_dict"])
    return state


@pytest.mark.parametrize("task", ["overfit", "pair_map"])
def test_a_run_of_an_older_version_ends_as_one_of_this_version(task, tmp_path):
    whole = run(task, tmp_path / "whole")
    with interrupted():
        run(task, tmp_path / "old")
    file = tmp_path / "old" / "last.ckpt"
    new = stored_state(file)
    torch.save(aged(stored_state(file)), file)
    lifted = stored_state(file)
    assert lifted.keys() == new.keys() and lifted["state_dict"].keys() == new["state_dict"].keys()
    assert lifted["callbacks"].keys() == new["callbacks"].keys()
    result = run(task, tmp_path / "old", resuming=True)
    for a, b in zip(result.map.parameters(), whole.map.parameters(), strict=True):
        assert torch.equal(a, b)
    assert isinstance(nsm.load(tmp_path / "old"), type(whole))
