"""Jobs of a sweep that are trained in one batch leave what each would alone."""

from __future__ import annotations

import copy
import csv
import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock
from interruption import interrupted
from omegaconf import OmegaConf
from safetensors.torch import load_file
from tiny import TRAINING

from nsm.config import compose_config
from nsm.pipeline import overfit
from nsm.pipeline.batched import Call, batches, run_batched
from nsm.pipeline.sweep_jobs import run_job

TINY = [
    *TRAINING,
    "data.steps_per_epoch=2",
    "logger=csv",
    "trainer.log_every=1",
    "trainer.log_pictures=0",
    "scheduler.peak=1",
]
BOTH = {
    name: {"_target_": f"nsm.results.loggers.{kind}"}
    for name, kind in (("tensorboard", "TensorBoard"), ("csv", "CSV"))
}
BENT = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 1\n0 1 0\n3 0 1 2\n3 0 2 3\n"


@pytest.fixture(scope="module")
def settings() -> dict[str, Any]:
    words: Any = OmegaConf.to_container(compose_config(TINY))
    return words


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """The smallest surface in the working folder."""
    (tmp_path / "patch.off").write_text(BENT)
    monkeypatch.chdir(tmp_path)


def changed(settings: dict[str, Any], job: Mapping[str, Any]) -> dict[str, Any]:
    settings = copy.deepcopy(settings)
    for key, value in job.items():
        *groups, name = key.split(".")
        node = settings
        for group in groups:
            node = node[group]
        node[name] = value
    return settings


def calls(sweep: str, settings: dict[str, Any], *jobs: Mapping[str, Any]) -> list[Call]:
    """The jobs of a sweep, with numbers for names."""
    return [
        (changed(settings, job), f"{Path.cwd()}/{sweep}/{number}", str(Path.cwd()))
        for number, job in enumerate(jobs)
    ]


def one_by_one(jobs: list[Call]) -> list[str | None]:
    return [run_job(*job, log=False) for job in jobs]


def in_one_batch(jobs: list[Call]) -> list[str | None]:
    ended = dict(run_batched(jobs))
    return [ended[number] for number in range(len(jobs))]


def leaves(tree: Any) -> Iterator[Any]:
    """What is in nested dictionaries and lists, with the keys."""
    if isinstance(tree, dict):
        for key in sorted(tree, key=str):
            yield key
            yield from leaves(tree[key])
    elif isinstance(tree, (list, tuple)):
        for value in tree:
            yield from leaves(value)
    else:
        yield tree


def assert_alike(one: Any, other: Any, **near: float) -> None:
    for a, b in zip(leaves(one), leaves(other), strict=True):
        if isinstance(a, (float, torch.Tensor)):
            torch.testing.assert_close(a, b, **near)
        else:
            assert a == b


def told(place: Path) -> dict[str, Any]:
    words: dict[str, Any] = json.loads((place / "metrics.json").read_text())
    return words


def curves(place: Path) -> list[dict[str, float]]:
    with (place / "csv" / "metrics.csv").open(newline="") as stream:
        rows = [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(stream)]
    for row in rows:
        row.pop("train/samples_per_second", None)
    return rows


def assert_as_alone(place: Path, alone: Path, **near: float) -> None:
    """Two folders of one job hold the same, to the accuracy of sums in another order."""
    near = near or {"rtol": 1e-3, "atol": 1e-4}
    files = [
        sorted(str(file.relative_to(p)).partition(".tfevents")[0] for file in p.rglob("*"))
        for p in (place, alone)
    ]
    assert files[0] == files[1]
    assert (place / "config.yaml").read_text() == (alone / "config.yaml").read_text()
    assert_alike(*(load_file(p / "surface.safetensors") for p in (place, alone)), **near)
    checkpoints = [torch.load(p / "last.ckpt", weights_only=True) for p in (place, alone)]
    for state in checkpoints:
        # a stopping rule that a batch does not have; counters that know of an interruption
        del state["callbacks"]["GradientWatch"], state["loops"]
    assert_alike(*checkpoints, **near)
    figures = [told(p) for p in (place, alone)]
    for words in figures:
        del words["seconds"]
        words.pop("batched", None)
    assert_alike(*figures, rtol=1e-2, atol=1e-3)
    assert_alike(curves(place), curves(alone), rtol=1e-2, atol=1e-5)


def test_each_job_leaves_what_it_would_alone(tmp_path, settings, monkeypatch):
    picture = np.zeros((2, 2, 3), dtype=np.uint8)
    monkeypatch.setattr(overfit, "reconstruction_image", lambda *_, **__: picture)
    (tmp_path / "high.off").write_text(BENT.replace("1 1 1", "1 1 2"))
    (tmp_path / "bad.off").write_text("not a mesh")
    settings = changed(settings, {"logger": BOTH, "trainer.log_pictures": 1})
    jobs: list[dict[str, Any]] = [
        {},
        {"surface.path": "bad.off"},
        {"surface.path": "high.off", "loss_weights.normal": 0.0},
        {"optimizer.lr": 1e-2, "seed": 1, "domain": {"_target_": "nsm.domains.Square"}},
    ]
    alone, batch = (calls(name, settings, *jobs) for name in ("alone", "together"))
    errors = one_by_one(alone), in_one_batch(batch)
    assert errors[0] == errors[1]
    assert [error is not None for error in errors[0]] == [False, True, False, False]
    left = [file.name for file in (tmp_path / "together" / "1").iterdir()]
    assert set(left) - {".lock"} == {"error.txt"}
    for number in (0, 2, 3):
        place = tmp_path / "together" / str(number)
        assert told(place)["batched"] == 3
        assert_as_alone(place, tmp_path / "alone" / str(number))


def test_an_interrupted_batch_ends_as_one_that_was_not(tmp_path, settings):
    jobs = [{"optimizer.lr": 1e-3}, {"optimizer.lr": 1e-2, "seed": 1}]
    assert in_one_batch(calls("whole", settings, *jobs)) == [None, None]
    cut = calls("cut", settings, *jobs)
    with interrupted():
        in_one_batch(cut)
    shutil.copytree(tmp_path / "cut", tmp_path / "serial")
    assert in_one_batch(cut) == [None, None]
    for number in ("0", "1"):
        assert told(tmp_path / "cut" / number)["batched"] == 2
        assert_as_alone(tmp_path / "cut" / number, tmp_path / "whole" / number, rtol=0, atol=0)
    # one of them from its checkpoint, the other, which has lost its own, from the beginning
    (tmp_path / "serial" / "1" / "last.ckpt").unlink()
    assert in_one_batch(calls("serial", settings, *jobs)) == [None, None]
    for number in ("0", "1"):
        assert "batched" not in told(tmp_path / "serial" / number)
        assert_as_alone(tmp_path / "serial" / number, tmp_path / "whole" / number)


def test_what_goes_wrong_goes_on_alone(tmp_path, settings):
    jobs = [{"loss_weights.normal": factor} for factor in (1e-3, 1e-2, 1e39)]
    batch = calls("together", settings, *jobs)
    errors = in_one_batch(batch)
    assert errors[:2] == [None, None]
    assert errors[2] is not None
    assert [told(Path(call[1]))["batched"] for call in batch[:2]] == [2, 2]


def test_what_is_held_or_complete_is_left_out(tmp_path, settings):
    jobs = calls("sweep", settings, {}, {"seed": 1}, {"seed": 2})
    (tmp_path / "sweep" / "0").mkdir(parents=True)
    (tmp_path / "sweep" / "2").mkdir()
    (tmp_path / "sweep" / "2" / "metrics.json").write_text("{}")
    with FileLock(tmp_path / "sweep" / "0" / ".lock"):
        held, *rest = in_one_batch(jobs)
    assert held is not None
    assert rest == [None, None]
    assert "batched" not in told(tmp_path / "sweep" / "1")
    assert told(tmp_path / "sweep" / "2") == {}


def test_which_jobs_are_trained_in_one_batch(settings):
    def sizes(*jobs: Mapping[str, Any], at_once: int = 16) -> list[int]:
        return [len(batch) for batch in batches([changed(settings, j) for j in jobs], at_once)]

    alike = {
        "seed": 1,
        "surface.path": "b.off",
        "domain": {"_target_": "nsm.domains.Square"},
        "optimizer.lr": 0.1,
        "loss_weights.normal": 0,
        "artefacts": True,
    }
    assert sizes(*({key: value} for key, value in alike.items()), at_once=4) == [4, 2]
    other = {
        "map.width": 8,
        "activation": {"_target_": "nsm.maps.activations.ReLU"},
        "encoding.resolutions": [8],
        "trainer.max_steps": 9,
        "optimizer": {"_target_": "torch.optim.SGD", "lr": 1e-3},
        "scheduler": {"_target_": "nsm.tasks.schedules.Constant"},
        "data.batch_size": 9,
        "trainer.precision": "bf16",
    }
    for key, value in other.items():
        jobs = [{"seed": 1}, {key: value}, {"seed": 2}, {key: value, "seed": 3}]
        assert sizes(*jobs) == [2, 2], key
    lonely = {
        "optimizer": {"_target_": "torch.optim.LBFGS"},
        "trainer.gradient_clip": 1.0,
        "trainer.stop_gradient_norm": 1e-9,
        "trainer.devices": 2,
        "logger": {"mine": {"_target_": "nsm.results.loggers.WandB"}},
        "task": {"_target_": "nsm.pipeline.param.ParamTask"},
        "loss_terms": {"mine": {"_target_": "mine.Term"}},
        "callbacks": {"mine": {"_target_": "mine.Callback"}},
        "data": {"_target_": "mine.Data"},
        "map.block": "mine",
    }
    for key, value in lonely.items():
        assert sizes({key: value, "seed": 1}, {key: value, "seed": 2}) == [1, 1], key
