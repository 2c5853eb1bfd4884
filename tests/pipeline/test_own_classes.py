"""A user's own classes in a run: named by ``_target_``, without a line of nsm's."""

import csv
import json

import pytest
import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback
from tiny import dome

import nsm
from nsm.config import compose_config
from nsm.data import SurfaceData
from nsm.errors import NsmError
from nsm.pipeline import Given, Task, run_task
from nsm.pipeline.task import frozen
from nsm.results import NeuralSurface
from nsm.tasks import Overfit

HERE = __name__
TINY = ["task=overfit", "data.batch_size=64", "data.held_out=64", "data.steps_per_epoch=2"]
TINY += ["trainer.max_steps=4", "encoding.resolutions=[4]", "map.width=8", "artefacts=false"]
TINY += ["trainer.progress=false", "logger=none", "trainer.log_every=1"]
SEEN: list = []


@pytest.fixture(autouse=True)
def forget():
    SEEN.clear()


@pytest.fixture(scope="module")
def surface():
    return dome(0.4, 4)


def run(surface, folder, *words):
    return run_task(compose_config([*TINY, *words]), folder, Given(surface=surface))


class MyCallback(Callback):
    def __init__(self, every: int = 1) -> None:
        self.every = every

    def on_train_batch_end(self, trainer, module, outputs, batch, index) -> None:
        SEEN.append((self.every, trainer.global_step))


def test_a_callback(surface, tmp_path):
    run(surface, tmp_path, f"+callbacks.mine._target_={HERE}.MyCallback", "+callbacks.mine.every=3")
    assert [(3, step) for step in (1, 2, 3, 4)] == SEEN


def test_what_is_no_callback_is_refused(surface, tmp_path):
    with pytest.raises(NsmError) as error:
        run(surface, tmp_path, "+callbacks.mine._target_=torch.nn.ReLU")
    assert error.value.key == "callbacks.mine"


class MySampler:
    def __init__(self, first: int = 0) -> None:
        self.first = first

    def draw(self, surface, count, generator):
        SEEN.append(count)
        return surface.at_vertices(self.first + torch.arange(count) % 5)


def test_a_sampler(surface, tmp_path):
    run(surface, tmp_path, f"sampler._target_={HERE}.MySampler", "+sampler.first=2")
    assert SEEN == [64] * 4


class MyData(SurfaceData):
    def __init__(self, repeat: int, **settings) -> None:
        super().__init__(**settings)
        SEEN.append((repeat, self.seed, self.sampler.vertex_share))


def test_a_data_module(surface, tmp_path):
    run(surface, tmp_path, f"data._target_={HERE}.MyData", "+data.repeat=2", "seed=5")
    assert SEEN == [(2, 5, 0.1)]


class MyTerm:
    def __init__(self, power: float = 2.0) -> None:
        self.power = power

    def __call__(self, evaluation):
        SEEN.append(evaluation)
        return evaluation.image.norm(dim=1) ** self.power


def test_a_loss_term(surface, tmp_path):
    words = [f"+loss_terms.mine._target_={HERE}.MyTerm", "+loss_terms.mine.weight=0.5"]
    run(surface, tmp_path, *words, "+loss_terms.mine.power=1.0", "logger=csv")
    assert SEEN[0].uv.shape == (64, 2) and SEEN[0].target.shape == (64, 2, 2)
    with (tmp_path / "csv" / "metrics.csv").open() as stream:
        first = next(row for row in csv.DictReader(stream) if row["train/loss"])
    weighted = [float(v) for k, v in first.items() if k.startswith("weighted/") and v]
    assert len(weighted) == 3 and sum(weighted) == pytest.approx(float(first["train/loss"]))
    assert float(first["weighted/mine"]) == pytest.approx(0.5 * float(first["train/mine"]))


def test_any_optimizer_and_scheduler_of_torch(surface, tmp_path):
    words = ["optimizer._target_=torch.optim.NAdam", "optimizer.lr=1.0e-3", "initialization=random"]
    words += ["scheduler._target_=torch.optim.lr_scheduler.ExponentialLR", "+scheduler.gamma=0.9"]
    run(surface, tmp_path, *words)
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)["optimizer_states"][0]
    assert state["param_groups"][0]["lr"] == pytest.approx(1e-3 * 0.9**4)


class Signed(Overfit):
    """The published module with one more line in its log."""

    def on_train_start(self) -> None:
        SEEN.append("started")


class MyTask(Task):
    """The shortest task: a module, and a result."""

    module, data, result, defaults = Signed, SurfaceData, NeuralSurface, "overfit"

    def prepare(self, given):
        self.surface = given.surface

    def build(self):
        return self.module(**self.shared_settings(), diagonal=self.surface.bounding_box_diagonal)

    def make_result(self, module):
        return NeuralSurface(self.surface, frozen(module.map), {"mine": 1.0}, self.settings)

    def figures(self, result):
        return {"note": "mine"}


def test_a_task(surface, tmp_path):
    words = [f"task._target_={HERE}.MyTask", "task.name=mine", "initialization=random"]
    result = run(surface, tmp_path, *words)
    assert SEEN == ["started"] and result.metrics == {"mine": 1.0}
    told = json.loads((tmp_path / "metrics.json").read_text())
    assert told["note"] == "mine" and told["metrics"] == {"mine": 1.0} and told["steps"] == 4
    assert isinstance(nsm.load(tmp_path), nsm.NeuralSurface)


def test_what_is_no_task_is_refused(surface, tmp_path):
    config = compose_config(TINY)
    config.task._target_ = "torch.nn.ReLU"
    del config.task["name"]
    with pytest.raises(NsmError) as error:
        run_task(config, tmp_path, Given(surface=surface))
    assert error.value.key == "task._target_"


def test_the_parts_of_lightning_that_have_no_public_way_are_there():
    """See AtomicCheckpoint: the number of steps that Lightning logs by."""
    trainer = pl.Trainer(logger=False, enable_checkpointing=False, enable_model_summary=False)
    assert trainer.fit_loop.epoch_loop._batches_that_stepped == 0
