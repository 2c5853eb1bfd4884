"""Precision of a training's matrix products."""

import pytest
import pytorch_lightning as pl
import torch

from nsm.config import compose_config
from nsm.domains import Surface
from nsm.pipeline import Given, run_task


@pytest.mark.parametrize(("words", "expected"), [([], "highest"), (["bf16"], "medium")])
def test_it_is_that_of_the_training_alone(words, expected, tmp_path, monkeypatch):
    config = compose_config(
        ["experiment=quick", "logger=none", *(f"trainer.precision={w}" for w in words)]
    )
    surface = Surface.load("hemisphere")
    seen = []

    def look(*_, **__):
        seen.append(torch.get_float32_matmul_precision())
        raise KeyboardInterrupt

    monkeypatch.setattr(pl.Trainer, "fit", look)
    with pytest.raises(KeyboardInterrupt):
        run_task(config, tmp_path, Given(surface=surface))
    assert seen == [expected]
    assert torch.get_float32_matmul_precision() == "highest"
