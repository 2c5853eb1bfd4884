"""Surfaces that are overfitted in one batch become what they would alone."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import torch
from rich.console import Console

import nsm
from nsm.config import compose_config
from nsm.pipeline import surface_cache
from nsm.pipeline.surface_cache import cached_surfaces

SMALL = [
    "experiment=quick",
    "trainer.max_steps=10",
    "data.held_out=256",
    "data.batch_size=64",
    "encoding.resolutions=[4,8]",
    "trainer.progress=false",
]


@pytest.fixture(scope="module")
def surfaces():
    words = {"domain": "disc", "parameterization": "tutte", "cache": False}
    return [nsm.Surface.load(name, **words) for name in ("hemisphere", "saddle", "hemisphere")]


def made(surfaces, words: list[str], *, together: bool) -> tuple[list[nsm.NeuralSurface], str]:
    config = compose_config(["task=pair_map", "seed=3"])
    config.phi.overrides = words
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:  # a GPU takes them in one batch
        patch.setattr(surface_cache, "accelerator_of", lambda _: "gpu" if together else "cpu")
        phis = cached_surfaces(surfaces, config, Console(file=printed))
    return phis, printed.getvalue()


def in_batches(cache: Path) -> list[int | None]:
    """How many were trained with each neural surface of a cache."""
    files = (cache / "neural").glob("*/metrics.json")
    return [json.loads(file.read_text()).get("batched") for file in files]


@pytest.mark.parametrize("words", [SMALL, [*SMALL, "loss_weights.normal=0", "sampler=pool"]])
def test_each_is_what_it_would_be_alone(surfaces, tmp_path, monkeypatch, words):
    monkeypatch.setenv("NSM_CACHE", str(tmp_path / "alone"))
    alone, _ = made(surfaces, words, together=False)
    monkeypatch.setenv("NSM_CACHE", str(tmp_path / "together"))
    both, told = made(surfaces, words, together=True)
    assert told.count(": neural surface in") == 2  # the third is the first
    uv = torch.as_tensor(surfaces[0].uv[:50], dtype=torch.float32)
    for a, b in zip(alone, both, strict=True):
        torch.testing.assert_close(a.map(uv), b.map(uv), rtol=1e-3, atol=1e-4)
        assert b.metrics["rms_percent"] == pytest.approx(a.metrics["rms_percent"], rel=0.01)
    again, told = made(surfaces, words, together=True)
    assert ": neural surface in" not in told and told.count("from the cache") == 3
    assert torch.equal(again[1].map(uv), both[1].map(uv))
    assert in_batches(tmp_path / "together") == [2, 2]


def test_where_the_gradient_of_one_decides_none_is_trained_with_others(
    surfaces, tmp_path, monkeypatch
):
    monkeypatch.setenv("NSM_CACHE", str(tmp_path))
    words = [*SMALL, "trainer.gradient_clip=1.0", "trainer.max_steps=2"]
    results, told = made(surfaces, words, together=True)
    assert len(results) == 3
    assert in_batches(tmp_path) == [None, None]
