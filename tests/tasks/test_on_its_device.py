"""A step's tensors are all where its network is.

The device is ``meta``, which holds no numbers and refuses most operations with a tensor of the CPU:
what is made on the CPU in passing would stop a step on a GPU.
"""

from copy import deepcopy

import numpy as np
import pytest
import torch

from nsm.config import compose_config
from nsm.data import Samples
from nsm.domains import Surface
from nsm.domains.joint_preparation import matched_landmarks
from nsm.pipeline import build_overfit
from nsm.pipeline.collection_map import build_collection_map
from nsm.pipeline.pair_map import build_pair_map
from nsm.pipeline.param import build_param
from nsm.results import NeuralSurface

SMALL = ["encoding.resolutions=[4,8]", "map.width=8"]


@pytest.fixture(scope="module")
def surface() -> Surface:
    return Surface.load("hemisphere")


@pytest.fixture
def phis(surface) -> list[NeuralSurface]:
    config = compose_config(["task=overfit", *SMALL])
    network = build_overfit(config, surface).map.eval().requires_grad_(False)
    return [NeuralSurface(surface, deepcopy(network)) for _ in range(3)]


def built(task, phis, words):
    config = compose_config([f"task={task}", *words])
    if task == "overfit":
        return build_overfit(config, phis[0].surface)
    if task == "param":
        return build_param(config, phis[0])
    count = 2 if task == "pair_map" else 3
    none = [np.zeros(0, dtype=np.int64)] * count
    matched = matched_landmarks([phi.surface for phi in phis[:count]], none)
    if task == "pair_map":
        return build_pair_map(config, phis[0], phis[1], matched)
    return build_collection_map(config, phis, matched)[0]


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("overfit", SMALL),
        ("overfit", ["experiment=paper", "map.width=8", "map.depth=2"]),
        ("param", SMALL),
        ("pair_map", SMALL),
        # the watch on triangles looks for those that are nearest to folding, by numbers
        ("collection_map", [*SMALL, "constraints.lambda_triangles=0"]),
    ],
)
def test_a_step_keeps_to_the_device_of_its_network(task, words, phis):
    module = built(task, phis, words).to("meta")
    module.log_every = 10**9  # there is no logger
    batch = Samples(*(torch.empty(64, size, device="meta") for size in (2, 3, 3)))
    loss = module.training_step(batch.uv if task == "collection_map" else batch, 0)
    loss.backward()
    trained = [p for p in module.parameters() if p.requires_grad]
    assert {p.grad.device.type for p in trained} == {"meta"} == {loss.device.type}


def test_the_device_refuses_what_is_on_another():
    with pytest.raises(RuntimeError, match="device"):
        torch.ones(4, 2, device="meta") + torch.ones(4, 2)
