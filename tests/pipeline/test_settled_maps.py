"""Maps end once they have settled: the distortion hardly changes, landmarks are met."""

import json
from functools import cache
from itertools import count

import pytest
import torch
from interruption import interrupted
from tiny import results

from nsm.config import compose_config
from nsm.pipeline import Given, run_task
from nsm.tasks import CollectionMap, PairMap, constrained, quasi_newton

WORDS = ["data.batch_size=64", "data.held_out=64", "data.steps_per_epoch=4", "logger=none"]
WORDS += ["trainer.max_steps=20", "trainer.threads=1", "trainer.progress=false", "artefacts=false"]
WORDS += ["map.cells=8", "constraints.triangles_from=0.8", "optimizer.iterations=4"]
WORDS += ["constraints.settled=1e9"]


@cache
def surfaces():
    """Two domes and their surfaces by random networks, the same in all trainings."""
    torch.manual_seed(0)
    return results(rings=3).neural


def mapped(folder, task="pair_map", resuming=False, words=()):
    """The steps of a training, and the coefficients of the map at its end."""
    phi, psi, third = surfaces()
    given = Given(source=phi, target=psi, landmarks=[(0, 0), (9, 8)])
    if task == "collection_map":
        given = Given(surfaces=(phi, psi, third), landmarks=[[0, 9], [0, 8], [0, 9]])
    config = compose_config([f"task={task}", *WORDS, *words])
    made = run_task(config, folder, given, resuming=resuming)
    steps = json.loads((folder / "metrics.json").read_text())["steps"]
    h = made.map if task == "pair_map" else made.maps[0]
    return steps, torch.cat([one.flatten() for one in h.state_dict().values()])


@pytest.fixture(autouse=True)
def anything_settles(monkeypatch):
    monkeypatch.setattr(constrained, "_MET", 1e9)
    for task in (PairMap, CollectionMap):
        monkeypatch.setattr(task, "flipped_percent", lambda self: torch.tensor(0.0))


@pytest.mark.parametrize("task", ["pair_map", "collection_map"])
def test_a_map_ends_after_a_step_that_hardly_changes_it(task, tmp_path):
    """The first quasi-Newton step is the 17th; the change of the second is the first known one."""
    assert mapped(tmp_path, task)[0] == 18


def test_a_map_goes_on_while_it_changes(tmp_path):
    assert mapped(tmp_path, words=["constraints.settled=0"])[0] == 20


def test_a_map_goes_on_while_it_misses_landmarks(tmp_path, monkeypatch):
    monkeypatch.setattr(constrained, "_MET", 0.0)
    assert mapped(tmp_path)[0] == 20


def test_a_map_goes_on_while_its_folds_open(tmp_path, monkeypatch):
    steps = count()
    monkeypatch.setattr(PairMap, "flipped_percent", lambda self: torch.tensor(3.0 ** -next(steps)))
    assert mapped(tmp_path / "fast")[0] == 20
    left = count(10, -1)
    monkeypatch.setattr(PairMap, "flipped_percent", lambda self: torch.tensor(float(next(left))))
    assert mapped(tmp_path / "slowly")[0] == 18


def test_a_settled_map_takes_no_step_more_when_it_is_resumed(tmp_path):
    _, whole = mapped(tmp_path / "whole")
    for at in (16, 18):
        folder = tmp_path / str(at)
        with interrupted(at=at):
            mapped(folder)
        steps, resumed = mapped(folder, resuming=True)
        assert steps == 18 and torch.equal(resumed, whole)


def test_a_checkpoint_has_what_the_next_step_goes_on_with_and_the_last_one_not(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(quasi_newton, "_NEAR", 1e9)
    words = ["constraints.settled=0", "data.steps_per_epoch=1"]
    _, whole = mapped(tmp_path / "whole", words=words)
    folder = tmp_path / "interrupted"
    with interrupted(at=19):
        mapped(folder, words=words)
    assert known(folder)
    _, resumed = mapped(folder, resuming=True, words=words)
    assert torch.equal(resumed, whole)
    assert not known(folder)


def known(folder):
    """What the checkpoint of a folder knows of the loss's curvature."""
    [state] = torch.load(folder / "last.ckpt", weights_only=True)["optimizer_states"]
    return state.get("known")


@pytest.mark.parametrize("ramp, times", [(0.4, 1), (1.0, 4)])
def test_a_step_goes_on_only_with_the_same_weights(ramp, times, tmp_path, monkeypatch):
    monkeypatch.setattr(quasi_newton, "_NEAR", 1e9)
    looked, curvatures = [], PairMap.curvatures
    monkeypatch.setattr(PairMap, "curvatures", lambda self: looked.append(1) or curvatures(self))
    mapped(tmp_path, words=["constraints.settled=0", f"constraints.ramp={ramp}"])
    assert len(looked) == times  # of four quasi-Newton steps
