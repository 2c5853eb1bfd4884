"""A step's tensors are all where its network is.

The device is ``meta``, which holds no numbers and refuses most operations with a tensor of the CPU:
what is made on the CPU in passing would stop a step on a GPU.
"""

from copy import deepcopy

import numpy as np
import pytest
import torch
from rich.console import Console

from nsm.config import compose_config
from nsm.data import Samples
from nsm.domains import Surface
from nsm.pipeline import built, make_task
from nsm.results import NeuralSurface

SMALL = ["encoding.resolutions=[4,8]", "map.width=8"]


@pytest.fixture(scope="module")
def surface() -> Surface:
    return Surface.load("hemisphere")


@pytest.fixture
def phis(surface) -> list[NeuralSurface]:
    network = module("overfit", surface, words=SMALL).map.eval().requires_grad_(False)
    return [NeuralSurface(surface, deepcopy(network)) for _ in range(3)]


def module(name, *inputs, words):
    task = make_task(compose_config([f"task={name}", *words]), Console())
    task.use(*inputs)
    return built(task)


def inputs(task, phis):
    if task == "overfit":
        return [phis[0].surface]
    if task == "param":
        return [phis[0]]
    none = [np.zeros(0, dtype=np.int64)] * len(phis)
    return [phis[0], phis[1], none[:2]] if task == "pair_map" else [phis, none]


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("overfit", SMALL),
        ("overfit", ["experiment=paper", "map.width=8", "map.depth=2"]),
        ("param", ["experiment=adam", *SMALL]),
        ("pair_map", ["map.cells=8"]),
        ("pair_map", ["experiment=adam", *SMALL]),
        # the watch on triangles looks for those that are nearest to folding, by numbers
        ("collection_map", ["experiment=adam", *SMALL, "loss_weights.triangles=0"]),
    ],
)
def test_a_step_keeps_to_the_device_of_its_network(task, words, phis):
    trained = module(task, *inputs(task, phis), words=words).to("meta")
    trained.log_every = 10**9  # there is no logger
    batch = Samples(*(torch.empty(64, size, device="meta") for size in (2, 3, 3)))
    loss = trained.training_step(batch.uv if task == "collection_map" else batch, 0)
    loss.backward()
    weights = [p for p in trained.parameters() if p.requires_grad]
    assert {p.grad.device.type for p in weights} == {"meta"} == {loss.device.type}


def test_the_device_refuses_what_is_on_another():
    with pytest.raises(RuntimeError, match="device"):
        torch.ones(4, 2, device="meta") + torch.ones(4, 2)
