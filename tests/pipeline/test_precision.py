"""Precision of a training's matrix products."""

import pytest
import pytorch_lightning as pl
import torch
from rich.console import Console

from nsm.config import compose_config
from nsm.domains import Surface
from nsm.pipeline import build_overfit, common
from nsm.results.callbacks import Pictures


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
    none = Pictures("none", lambda module: None, 0)
    module = build_overfit(config, surface)
    with pytest.raises(KeyboardInterrupt):
        common.train(config, tmp_path, surface, module, Console(), none, resuming=False)
    assert seen == [expected]
    assert torch.get_float32_matmul_precision() == "highest"
