"""The command as users run it: in a subprocess, from a folder of their own."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import nsm

QUICK = [
    "experiment=quick",
    "data.held_out=2048",
    "trainer.threads=1",
    "trainer.log_every=10",
]


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "nsm", *words]


def run(folder: Path, *words: str, **extra) -> subprocess.CompletedProcess:
    environment = {**os.environ, "NSM_CACHE": str(folder / "cache"), "COLUMNS": "200"}
    return subprocess.run(
        command(*words), cwd=folder, env=environment, capture_output=True, text=True, **extra
    )


def only_run_folder(folder: Path) -> Path:
    found = list((folder / "outputs" / "overfit").iterdir())
    assert len(found) == 1, found
    return found[0]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, Path, str]:
    """One whole run from a raw mesh file: (working folder, run folder, printed text)."""
    folder = tmp_path_factory.mktemp("work")
    trimesh.creation.icosphere(subdivisions=3).export(folder / "ball.obj")
    result = run(folder, "task=overfit", "surface.path=ball.obj", *QUICK)
    assert result.returncode == 0, result.stderr
    return folder, only_run_folder(folder), result.stdout


def test_it_prints_where_the_results_are(finished):
    _, folder, text = finished
    assert str(folder) in text


def test_the_run_folder_is_complete(finished):
    _, folder, _ = finished
    for name in (
        "config.yaml",
        "last.ckpt",
        "surface.safetensors",
        "surface.json",
        "reconstruction.obj",
        "reconstruction.glb",
        "error.png",
        "checkerboard.png",
        "evolution.png",
        "metrics.json",
    ):
        assert (folder / name).stat().st_size > 0, name
    assert not list(folder.rglob("*.tmp"))
    with Image.open(folder / "evolution.png") as strip:
        assert strip.width % strip.height == 0 and strip.width >= 2 * strip.height


def test_the_glb_file_is_valid(finished, valid_gltf):
    assert valid_gltf(finished[1]) == {"reconstruction.glb"}


def test_the_result_is_the_shape(finished):
    _, folder, _ = finished
    metrics = json.loads((folder / "metrics.json").read_text())["metrics"]
    assert metrics["rms_percent"] < 0.2
    points = np.asarray(trimesh.load(folder / "reconstruction.obj", process=False).vertices)
    radius = np.linalg.norm(points - points.mean(axis=0), axis=1)
    assert radius.std() / radius.mean() < 0.05


def test_tensorboard_holds_scalars_and_pictures(finished):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    _, folder, _ = finished
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"images": 0})
    events.Reload()
    scalars = set(events.Tags()["scalars"])
    assert {"train/loss", "train/position", "train/normal", "val/rms_percent"} <= scalars
    assert "train/gradient_norm" in scalars
    assert len(events.Images("surface")) == 2
    errors = [event.value for event in events.Scalars("val/rms_percent")]
    figures = json.loads((folder / "metrics.json").read_text())["metrics"]
    assert errors[-1] == pytest.approx(figures["rms_percent"], rel=0.2)


def test_load_gives_it_back(finished):
    _, folder, _ = finished
    phi = nsm.load(folder)
    stored = json.loads((folder / "metrics.json").read_text())["metrics"]
    assert phi.metrics == stored
    vertices = phi(phi.surface.uv)
    given = phi.in_original_units(phi.surface.vertices)
    error = np.linalg.norm(vertices - given, axis=1)
    assert error.mean() < 0.05 * np.linalg.norm(np.ptp(given, axis=0))


def test_same_seed_same_result_and_another_differs(tmp_path):
    weights = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        surface = nsm.Surface.load("hemisphere", cache=False)
        overrides = [*QUICK, "trainer.max_steps=10", "logger=none", "artefacts=false"]
        overrides.append(f"seed={seed}")
        nsm.overfit(surface, overrides=overrides, folder=tmp_path / name, progress=False)
        weights.append(nsm.load(tmp_path / name).map.state_dict())
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert not all(torch.equal(weights[0][key], weights[2][key]) for key in weights[0])


def test_killed_and_resumed_ends_as_if_never_killed(tmp_path, here, monkeypatch):
    words = ["surface=hemisphere", *QUICK, "data.steps_per_epoch=10", "trainer.max_steps=60"]
    words += ["logger=none", "artefacts=false"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    monkeypatch.chdir(whole)
    assert here(*words).returncode == 0
    process = subprocess.Popen(
        command(*words), cwd=killed, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 120
    while not list(killed.glob("outputs/overfit/*/last.ckpt")):
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    folder = only_run_folder(killed)
    assert not (folder / "metrics.json").exists()
    monkeypatch.chdir(killed)
    result = here(f"resume={folder}")
    assert result.returncode == 0, result.stderr
    a = nsm.load(only_run_folder(whole)).map.state_dict()
    b = nsm.load(folder).map.state_dict()
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert only_run_folder(killed) == folder


def test_a_map_can_be_called_with_numpy_and_torch(finished):
    _, folder, _ = finished
    phi = nsm.load(folder)
    uv = phi.surface.uv[:5]
    assert isinstance(phi(uv), np.ndarray)
    assert phi.jacobian(uv).shape == (5, 3, 2)
    assert isinstance(phi(torch.as_tensor(uv, dtype=torch.float32)), torch.Tensor)


def stl_of_nothing(folder: Path) -> None:
    (folder / "bad.stl").write_bytes(b"solid nothing\nendsolid nothing\n")


def obj_with_nan(folder: Path) -> None:
    (folder / "bad.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")


def truncated_ply(folder: Path) -> None:
    data = trimesh.creation.icosphere(subdivisions=2).export(file_type="ply")
    (folder / "bad.ply").write_bytes(data[: len(data) // 2])


def text_file(folder: Path) -> None:
    (folder / "bad.off").write_text("Dear reader,\nthis is not a mesh.\n")


def two_balls(folder: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    other = ball.copy()
    other.apply_translation([5, 0, 0])
    trimesh.util.concatenate([ball, other]).export(folder / "bad.obj")


def moebius(folder: Path) -> None:
    n = 40
    lines, faces = [], []
    for k in range(n):
        for side in (-0.3, 0.3):
            t = 2 * np.pi * k / n
            r = 1 + side * np.cos(t / 2)
            lines.append(f"v {r * np.cos(t)} {r * np.sin(t)} {side * np.sin(t / 2)}")
    for k in range(n):
        a, b = 2 * k, 2 * k + 1
        c, d = (2 * k + 2, 2 * k + 3) if k < n - 1 else (1, 0)
        faces += [f"f {a + 1} {c + 1} {b + 1}", f"f {b + 1} {c + 1} {d + 1}"]
    (folder / "bad.obj").write_text("\n".join(lines + faces) + "\n")


def fin(folder: Path) -> None:
    """Three faces on one edge."""
    (folder / "bad.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 -1 0\nv 0 0 1\nf 1 2 3\nf 2 1 4\nf 1 2 5\n"
    )


def index_out_of_range(folder: Path) -> None:
    (folder / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")


def unknown_format(folder: Path) -> None:
    (folder / "bad.docx").write_text("v 0 0 0\n")


@pytest.mark.parametrize(
    ("make", "file"),
    [
        (stl_of_nothing, "bad.stl"),
        (obj_with_nan, "bad.obj"),
        (truncated_ply, "bad.ply"),
        (text_file, "bad.off"),
        (two_balls, "bad.obj"),
        (moebius, "bad.obj"),
        (fin, "bad.obj"),
        (index_out_of_range, "bad.off"),
        (unknown_format, "bad.docx"),
        (lambda folder: None, "missing.obj"),
    ],
)
def test_a_bad_mesh_is_one_line_and_status_2(tmp_path, here, make, file):
    make(tmp_path)
    refused(here(f"surface.path={file}", *QUICK), file.split(".")[0], tmp_path)


def test_bad_input_in_a_process_of_its_own(tmp_path):
    two_balls(tmp_path)
    refused(run(tmp_path, "surface.path=bad.obj"), "bad", tmp_path)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["surface=bunnny"], "bunny"),
        (["surface.name=../../etc/passwd"], "passwd"),
        (["trainer.max_stepps=3"], "max_steps"),
        (["trainer.max_steps=many"], "trainer.max_steps"),
        (["domain=circle"], "domain"),
        (["activation.gamma=3"], "gamma"),
        (["+activation.gamma=3"], "gamma"),
        (["map.block=skip"], "skip"),
        (["surface=hemisphere", "surface.seam_vertices=[0,99999]"], "99999"),
        (["surface=hemisphere", "trainer.accelerator=tpuu"], "accelerator"),
        (["resume=nowhere"], "nowhere"),
        (["resume=nowhere", "trainer.max_steps=9"], "trainer.max_steps=9"),
        (["mine.obj"], "mine"),
        (["version"], "version"),
        (["surface=hemisphere", "seed=0,1"], "seed=0,1"),
        (["surface.path=a, (b).obj"], "(b).obj"),
    ],
)
def test_a_bad_setting_is_one_line_and_status_2(tmp_path, here, words, expected):
    refused(here(*words), expected, tmp_path)


def refused(result: subprocess.CompletedProcess, expected: str, folder: Path) -> None:
    assert result.returncode == 2, result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert expected in lines[0]
    assert "Traceback" not in result.stdout + result.stderr
    left = [p for p in folder.rglob("*") if p.is_file() and "cache" not in p.parts]
    assert [p for p in left if not p.name.startswith("bad.")] == []


def test_a_damaged_checkpoint_is_one_line(finished, tmp_path, here, monkeypatch):
    work, folder, _ = finished
    monkeypatch.chdir(work)
    copy = tmp_path / "run"
    shutil.copytree(folder, copy)
    (copy / "last.ckpt").write_bytes((copy / "last.ckpt").read_bytes()[:1000])
    result = here(f"resume={copy}")
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1
    assert "last.ckpt" in result.stderr
