"""Logs of a run: what is in them, after resuming too, and how TensorBoard compares runs."""

import csv
import importlib.util
import io
import json
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tensorboard import program
from tensorboard.backend.event_processing.event_accumulator import (
    HISTOGRAMS,
    IMAGES,
    TENSORS,
    EventAccumulator,
)
from tensorboard.summary.writer import event_file_writer
from tensorboard.util import tensor_util

import nsm
from nsm.config import compose_config
from nsm.errors import NsmError
from nsm.pipeline import Given, run_task
from nsm.results.metrics import evaluate

QUICK = ["experiment=quick", "data.held_out=512", "trainer.log_every=5", "trainer.progress=false"]
TINY = [
    *QUICK,
    "initialization=random",
    "data.batch_size=64",
    "data.steps_per_epoch=10",
    "trainer.max_steps=20",
]

ACTIVATIONS = {0.001: "softplus", 0.002: "softplus_paper"}  # one class, with two parameters


def overfitted(folder: Path, *words: str):
    surface = nsm.Surface.load("plane", cache=False)
    return nsm.overfit(surface, overrides=[*TINY, *words], folder=folder, progress=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of one sweep, with all logs on the disk."""
    folder = tmp_path_factory.mktemp("runs")
    words = ["logger=both", "sampler.vertex_share=0"]
    words += ["trainer.log_pictures=3", "trainer.log_histograms=2"]
    for rate, activation in ACTIVATIONS.items():
        own = [f"optimizer.lr={rate}", f"activation={activation}"]
        overfitted(folder / str(rate), *own, *words)
    return folder


def events(folder: Path) -> EventAccumulator:
    return EventAccumulator(str(folder), {TENSORS: 0, IMAGES: 0, HISTOGRAMS: 0}).Reload()


def test_weighted_terms_add_up_to_the_loss(runs):
    board = events(runs / "0.001" / "tensorboard")
    values = {k: [e.value for e in board.Scalars(k)] for k in board.Tags()["scalars"]}
    assert len(values["train/loss"]) == 4
    total = np.add(values["weighted/position"], values["weighted/normal"])
    np.testing.assert_allclose(total, values["train/loss"], rtol=1e-5)
    ratio = np.divide(values["weighted/normal"], values["train/normal"])
    np.testing.assert_allclose(ratio, 0.01, rtol=1e-5)
    assert {"train/gradient_norm", "val/rms_percent"} <= set(values)
    assert min(values["train/samples_per_second"]) > 64
    # at step 4 of 20: risen by 5/101 in the warmup, and 0.2 of the half-wave down
    expected = 0.001 * 5 / 101 * 0.5 * (1 + np.cos(0.2 * np.pi))
    np.testing.assert_allclose(values["learning_rate/network"][0], expected, rtol=1e-4)
    assert values["learning_rate/encoding"][0] > values["learning_rate/network"][0]


def test_the_table_holds_the_same_curves(runs):
    board = events(runs / "0.001" / "tensorboard")
    with (runs / "0.001" / "csv" / "metrics.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["train/loss"]]
    expected = {e.step: e.value for e in board.Scalars("train/loss")}
    assert {int(r["step"]): float(r["train/loss"]) for r in rows} == pytest.approx(expected)


def test_tensorboard_compares_runs_by_their_final_figures(runs):
    board = program.TensorBoard()
    board.configure(argv=[None, "--logdir", str(runs), "--port", "0", "--load_fast=false"])
    place = f"{board.launch()}data/plugin/hparams"

    def ask(what: str, **words):
        data = json.dumps({"experimentName": "", **words}).encode()
        head = {"Content-Type": "application/json"}
        with urllib.request.urlopen(urllib.request.Request(f"{place}/{what}", data, head)) as page:
            return json.load(page)

    deadline = time.monotonic() + 30
    while len((found := ask("experiment")).get("hparamInfos", ())) == 0:
        assert time.monotonic() < deadline
        time.sleep(0.2)
    groups = ask("session_groups", allowedStatuses=["STATUS_SUCCESS"], sliceSize=10)
    # what the page shows first: settings that differ, by their options' names, and figures
    assert {one["name"] for one in found["hparamInfos"] if one.get("differs")} == {
        "activation",
        "activation.beta",
        "optimizer.lr",
    }
    of_figures = [m["name"]["tag"].startswith("figures/") for m in found["metricInfos"]]
    assert of_figures == sorted(of_figures, reverse=True) and any(of_figures)
    rows = {group["hparams"]["optimizer.lr"]: group for group in groups["sessionGroups"]}
    assert set(rows) == {0.001, 0.002}
    for rate, group in rows.items():
        stored = json.loads((runs / str(rate) / "metrics.json").read_text())["metrics"]
        shown = {v["name"]["tag"]: v["value"] for v in group["metricValues"]}
        assert shown["figures/rms_percent"] == pytest.approx(stored["rms_percent"], rel=1e-5)
        assert group["hparams"]["activation"] == ACTIVATIONS[rate]


def test_each_job_is_one_run_without_a_curve_of_epochs(runs):
    places = {file.parent for file in runs.rglob("events.out.tfevents.*")}
    assert places == {runs / str(rate) / "tensorboard" for rate in ACTIVATIONS}
    for place in places:
        assert "epoch" not in events(place).Tags()["scalars"]


def test_pictures_are_those_of_the_start_and_of_the_end_and_between(runs):
    board = events(runs / "0.001" / "tensorboard")
    (tag,) = board.Tags()["images"]
    assert [event.step for event in board.Images(tag)] == [0, 10, 20]
    pictures = [
        np.asarray(Image.open(io.BytesIO(one.encoded_image_string))) for one in board.Images(tag)
    ]
    assert all(one.shape == (384, 384, 3) for one in pictures)
    assert (pictures[0] != pictures[2]).any()


def test_large_meshes_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr("nsm.results.callbacks._MOST_VERTICES", 3)
    overfitted(tmp_path, "logger=tensorboard", "artefacts=false", "trainer.log_pictures=0")
    tags = events(tmp_path / "tensorboard").Tags()["tensors"]
    assert all("_hparams_" in tag for tag in tags)


@pytest.mark.parametrize("task", ["pair_map", "collection_map", "param"])
def test_curves_of_held_out_points_have_several_points(task):
    config = compose_config([f"task={task}"])
    assert config.trainer.max_steps // config.data.steps_per_epoch >= 6


def test_meshes_are_those_of_the_surface_as_it_learns(runs):
    board = events(runs / "0.001" / "tensorboard")
    tags = {tag.split("_")[-1]: tag for tag in board.Tags()["tensors"] if "_hparams_" not in tag}

    def parts(tag):
        found = board.Tensors(tags[tag])
        assert [event.step for event in found] == [0, 20]
        return [tensor_util.make_ndarray(event.tensor_proto)[0] for event in found]

    phi = nsm.load(runs / "0.001")
    start, end = parts("VERTEX")
    np.testing.assert_allclose(end, evaluate(phi.map, phi.surface.uv), atol=1e-6)
    assert np.abs(start - end).max() > 1e-4
    np.testing.assert_array_equal(parts("FACE")[0], phi.surface.faces)
    assert parts("COLOR")[0].max() <= 255 and np.ptp(parts("COLOR")[0], axis=0).max() > 200


def test_histograms_count_every_weight(runs):
    board = events(runs / "0.001" / "tensorboard")
    network = nsm.load(runs / "0.001").map
    weights = {f"weights/map.{name}": one.numel() for name, one in network.named_parameters()}
    assert weights.keys() <= set(board.Tags()["histograms"])
    for tag, count in weights.items():
        found = board.Histograms(tag)
        assert [(one.step, one.histogram_value.num) for one in found] == [(0, count), (20, count)]
        gradients = board.Histograms(tag.replace("weights", "gradients"))
        assert [one.step for one in gradients] == [1, 20]  # none before the first step


@pytest.mark.parametrize("number", [0, 9])
def test_a_resumed_run_goes_on_in_the_same_logs(number, tmp_path, monkeypatch):
    # TensorBoard numbers its files; read by name, the tenth comes before the ninth of one second
    counter = event_file_writer.AtomicCounter(number)
    monkeypatch.setattr(event_file_writer, "_global_uid", counter)
    config = compose_config(["task=overfit", *TINY, "logger=both", "artefacts=false"])
    surface = nsm.Surface.load("plane", cache=False)
    for resuming, steps in ((False, 20), (True, 30)):
        config.trainer.max_steps = steps
        run_task(config, tmp_path, Given(surface=surface), resuming=resuming)
    with (tmp_path / "csv" / "metrics.csv").open() as stream:
        steps = [int(row["step"]) for row in csv.DictReader(stream) if row["train/loss"]]
    assert steps == [4, 9, 14, 19, 24, 29]
    board = events(tmp_path / "tensorboard")
    assert [e.step for e in board.Scalars("train/loss")] == steps


def test_what_was_logged_beyond_the_checkpoint_is_dropped(tmp_path):
    overfitted(tmp_path, "logger=both", "artefacts=false")
    file = tmp_path / "csv" / "metrics.csv"
    header = file.read_text().splitlines()[0].split(",")
    with file.open("a") as stream:  # as if it had been killed at step 25, after this
        stray = csv.DictWriter(stream, header)
        stray.writerow({**dict.fromkeys(header, ""), "step": 24, "train/loss": 77.0})
    config = compose_config(["task=overfit", *TINY, "logger=both", "artefacts=false"])
    config.trainer.max_steps = 30
    given = Given(surface=nsm.Surface.load("plane", cache=False))
    run_task(config, tmp_path, given, resuming=True)
    with file.open() as stream:
        rows = {int(r["step"]): r["train/loss"] for r in csv.DictReader(stream) if r["train/loss"]}
    assert sorted(rows) == [4, 9, 14, 19, 24, 29] and float(rows[24]) < 77


@pytest.mark.parametrize("kind", ["wandb", "mlflow"])
def test_a_logger_that_is_not_installed_is_refused_before_any_work(
    kind, monkeypatch, here, tmp_path
):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == kind else found(name, *a)
    )
    result = here("surface=plane", f"logger={kind}")
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1 and kind in result.stderr
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


def test_any_logger_of_lightning_works(tmp_path):
    words = ["logger=none", "+logger.mine._target_=pytorch_lightning.loggers.CSVLogger"]
    overfitted(tmp_path, *words, f"+logger.mine.save_dir={tmp_path}", "artefacts=false")
    rows = list(csv.DictReader(next(tmp_path.rglob("version_0/metrics.csv")).open()))
    assert any(row["train/loss"] for row in rows)


def test_what_is_no_logger_is_refused(tmp_path):
    words = ["logger=none", "+logger.mine._target_=torch.nn.ReLU"]
    with pytest.raises(NsmError) as error:
        overfitted(tmp_path, *words)
    assert error.value.key == "logger.mine"


def test_wandb_keeps_a_run_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="wandb is not installed")
    monkeypatch.setenv("WANDB_MODE", "offline")
    overfitted(tmp_path, "logger=wandb", "artefacts=false")
    assert list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))
    assert json.loads((tmp_path / "logger.json").read_text())["wandb"]


def test_mlflow_stores_curves_and_figures(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed")
    monkeypatch.chdir(tmp_path)  # where it puts pictures, whatever the store is
    store = f"sqlite:///{tmp_path}/mlflow.db"
    phi = overfitted(tmp_path / "run", "logger=mlflow", f"logger.uri={store}", "artefacts=false")
    run_id = json.loads((tmp_path / "run" / "logger.json").read_text())["mlflow"]
    client = mlflow.tracking.MlflowClient(store)
    run = client.get_run(run_id)
    assert run.data.params["optimizer.lr"] == "0.003" and run.info.status == "FINISHED"
    figure = run.data.metrics["figures/rms_percent"]
    assert figure == pytest.approx(phi.metrics["rms_percent"], rel=1e-5)
    assert len(client.get_metric_history(run_id, "train/loss")) == 4
