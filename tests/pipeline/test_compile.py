"""Trainings whose evaluations are compiled."""

from __future__ import annotations

from functools import partial

import pytest
import torch

import nsm

WORDS = [
    "experiment=quick",
    "logger=none",
    "trainer.max_steps=12",
    "data.steps_per_epoch=6",
    "data.batch_size=64",
    "data.held_out=100",
    "encoding.resolutions=[4,8]",
    "trainer.accelerator=cpu",
]


@pytest.fixture(scope="module")
def surface():
    return nsm.Surface.load("hemisphere", parameterization="tutte")


def weights(phi: nsm.NeuralSurface) -> torch.Tensor:
    return torch.nn.utils.parameters_to_vector(phi.map.parameters())


def test_they_end_at_the_same_result(surface, monkeypatch):
    compiled = []

    def cheaply(function, **_):  # the whole way but for the last step, the machine's code
        compiled.append(function.__qualname__)
        return compile_(function, backend="aot_eager", dynamic=False)

    compile_ = torch.compile
    monkeypatch.setattr(torch, "compile", cheaply)
    plain = nsm.overfit(surface, overrides=WORDS, progress=False)
    assert not compiled
    phi = nsm.overfit(surface, overrides=[*WORDS, "trainer.compile=true"], progress=False)
    assert len(compiled) == 1
    torch.testing.assert_close(weights(phi), weights(plain), rtol=1e-4, atol=1e-5)
    f = partial(nsm.map_pair, phi, "sphere_cap", progress=False)
    words = [w for w in WORDS if not w.startswith(("experiment", "encoding"))]
    a, b = (f(overrides=[*words, f"trainer.compile={word}"]) for word in ("true", "false"))
    assert len(compiled) == 2
    x = torch.as_tensor(surface.vertices[:50])
    torch.testing.assert_close(torch.as_tensor(a(x)), torch.as_tensor(b(x)), rtol=1e-4, atol=1e-4)


def test_without_a_compiler_they_go_on(surface, monkeypatch, capsys):
    def no_compiler(function, **_):
        def call(x):
            raise RuntimeError("no C++ compiler\nis here")

        return call

    plain = nsm.overfit(surface, overrides=WORDS, progress=False)
    monkeypatch.setattr(torch, "compile", no_compiler)
    phi = nsm.overfit(surface, overrides=[*WORDS, "trainer.compile=true"])
    assert torch.equal(weights(phi), weights(plain))
    assert "not compiled" in capsys.readouterr().out
