"""The trials of benchmarks/steps.py do not depend on the default, and their results are found."""

import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from nsm.config import compose_config

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import steps  # noqa: E402
from candidates import parted  # noqa: E402

EVERY = {key: changes for trials in steps.TRIALS.values() for key, changes in trials.items()}
OTHER_DEFAULT = [
    "map.linear_skip=linear",
    "map.width=128",
    "encoding.resolutions=[32,128,512]",
    "optimizer.lr=1e-4",
    "loss_weights.normal=0",
    "data.batch_size=2048",
    "sampler.vertex_share=0",
    "sampler.domain_share=1",
    "scheduler.warmup=0",
]


def test_the_base_overrides_the_default():
    assert compose_config([*OTHER_DEFAULT, *steps.in_full([])]) == compose_config(steps.in_full([]))


@pytest.mark.parametrize(
    ("trial", "key", "value"),
    [
        ("fitted, Fourier, 64", "encoding.features", 64),
        ("no normals", "loss_weights.normal", 0.0),
        ("grid of degree 3", "map.linear_skip", "none"),
    ],
)
def test_a_change_replaces_the_base(trial, key, value):
    assert OmegaConf.select(compose_config(steps.in_full(EVERY[trial])), key) == value


def test_every_result_is_of_a_trial():
    slugs = [steps.slug(key) for key in EVERY]
    assert len(set(slugs)) == len(slugs)
    made = {file.stem for file in steps.RESULTS.glob("*/*.json")}
    assert made <= set(slugs)
    assert sum(len(found) for found in steps.results().values()) == len(
        list(steps.RESULTS.glob("*/*.json"))
    )


@pytest.mark.parametrize("key", list(steps.TRIALS["from the fitted start"]))
def test_trials_from_the_fitted_start_have_its_grid(key):
    config = compose_config(parted(steps.in_full(EVERY[key]))[0])
    assert config.map.linear_skip == "fitted"
    assert list(config.encoding.resolutions) == [32, 128, 512]
