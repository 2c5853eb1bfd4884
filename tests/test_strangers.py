"""Files from strangers: no code of theirs runs, and none takes more memory than its size."""

import json
import os
import pickle
import resource
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from omegaconf import OmegaConf
from safetensors.numpy import load_file, save_file

import nsm
from nsm.config import read_config
from nsm.errors import NsmError
from nsm.instantiation import check_trusted, is_trusted
from nsm.results.files import check_stored
from nsm.surfaces.landmark_files import read_landmarks
from nsm.surfaces.loading import load_mesh

TINY = [
    "experiment=quick",
    "surface.parameterization=tutte",
    "trainer.max_steps=2",
    "encoding.resolutions=[4]",
    "data.held_out=64",
    "data.batch_size=64",
    "trainer.progress=false",
    "artefacts=false",
    "logger=none",
]


class Trap:
    """Pickled, it makes a file when it is loaded."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    surface = nsm.Surface.load("cone", cache=False)
    nsm.overfit(surface, overrides=TINY, folder=folder, progress=False)
    return folder


@pytest.fixture
def copy(finished, tmp_path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def traps(file: Path):
    """Checkpoints that run code once they are unpickled, in the ways that torch.load reads."""
    yield pickle.dumps(Trap(file))
    whole = file.with_name("trap.ckpt")
    torch.save({"state_dict": {}, "callbacks": Trap(file)}, whole)
    yield whole.read_bytes()
    torch.save(Trap(file), whole, _use_new_zipfile_serialization=False)
    yield whole.read_bytes()


def test_the_traps_are_sharp(tmp_path):
    for data in traps(tmp_path / "sprung"):
        (tmp_path / "bad.ckpt").write_bytes(data)
        try:
            torch.load(tmp_path / "bad.ckpt", weights_only=False)
        except Exception:
            pickle.loads(data)
        assert (tmp_path / "sprung").exists()
        (tmp_path / "sprung").unlink()


def test_a_checkpoint_runs_nothing(copy, tmp_path, here):
    for data in traps(tmp_path / "sprung"):
        (copy / "last.ckpt").write_bytes(data)
        result = here(f"resume={copy}")
        assert result.returncode == 2
        assert "last.ckpt" in result.stderr
        assert len(result.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "sprung").exists()


def test_a_checkpoint_cannot_swell(copy, here):
    with zipfile.ZipFile(copy / "last.ckpt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(50_000_000))
    assert (copy / "last.ckpt").stat().st_size < 100_000
    with pytest.raises(ValueError):
        check_stored(copy / "last.ckpt")
    assert here(f"resume={copy}").returncode == 2


class Made:
    """Pickled, it is what a function makes of a number, when it is loaded."""

    def __init__(self, make, size: int) -> None:
        self.make, self.size = make, size

    def __reduce__(self):
        return self.make, (self.size,)


def test_a_checkpoint_makes_no_room_by_a_number(copy, here):
    """torch's own safe reading would take two gigabytes for these few bytes."""
    torch.save({"global_step": 1, "callbacks": Made(bytearray, 2 * 10**9)}, copy / "last.ckpt")
    assert (copy / "last.ckpt").stat().st_size < 10_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result = here(f"resume={copy}")
    assert result.returncode == 2 and "last.ckpt" in result.stderr
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000  # kB


def test_a_checkpoint_of_ours_is_read(finished):
    check_stored(finished / "last.ckpt")


def test_pipes_are_not_waited_for(copy):
    (copy / "surface.safetensors").unlink()
    os.mkfifo(copy / "surface.safetensors")
    os.mkfifo(copy / "marks.vts")
    for load, file in ((nsm.load, copy), (read_landmarks, copy / "marks.vts")):
        with pytest.raises(NsmError) as refused:
            load(file)
        assert refused.value.kind == "not_a_file"


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "torch.load",
        "torch.nn.Linear",
        "torch.nn.modules.activation.torch.load",
        "torch.nn.functional.relu",
        "nsm.maps.networks.torch.load",
        "nsm.tasks.os.system",
        "nsm.results.files.atomic_write",
        "nsm.results.loggers.shutil.rmtree",
        "nsm.results.loggers.Path",
        "nsm.pipeline.overfit.atomic_write",
        "nsm.cli.main",
        "nsm.instantiation.made",
        "nsm.maps",
        "nsm.maps.",
        "nsm.maps..x",
        "nsm.maps.\0.x",
        "nsm.maps.not_there",
        "hydra.utils.instantiate",
        "mine_for_test.os.system",
        "mine_for_test.opened",
        "${x}",
        "['os.system']",
        "",
    ],
)
def test_targets_that_stored_settings_may_not_name(mine, target):
    assert not is_trusted(target, trust=["mine_for_test"])
    for settings in ({"_target_": target}, {"a": [{"b": ({"_target_": target},)}]}):
        with pytest.raises(NsmError) as refused:
            check_trusted(settings)
        assert refused.value.kind in ("not_trusted", "interpolation")


@pytest.mark.parametrize(
    "settings",
    [
        {"_target_": "nsm.maps.NeuralMap", "activation": "${oc.decode:'{_target_: os.system}'}"},
        {"_target_": "nsm.maps.NeuralMap", "${oc.env:HOME}": 1},
        {"_target_": "nsm.results.loggers.CSV", "folder": "/elsewhere"},
        {"_target_": "nsm.results.loggers.CSV", "_args_": ["/elsewhere"]},
        {"_target_": ["os.system"]},
        {"_target_": {"_target_": "nsm.maps.NeuralMap"}},
    ],
)
def test_settings_that_would_do_more_than_compute(settings):
    for given in (settings, OmegaConf.create({"x": [settings]})):
        with pytest.raises(NsmError) as refused:
            check_trusted(given)
        assert refused.value.kind in ("not_trusted", "interpolation")


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """A module of the user's, which leaves a file when it is imported."""
    (tmp_path / "mine_for_test.py").write_text(
        "import os\nimport pathlib\nimport torch\nfrom io import open as opened\n"
        "pathlib.Path(__file__).with_name('imported').touch()\n"
        "class Halved(torch.nn.Module):\n    def forward(self, z):\n        return z / 2\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / "imported"
    sys.modules.pop("mine_for_test", None)


def test_code_of_a_file_runs_if_its_module_is_trusted(copy, mine):
    settings = json.loads((copy / "surface.json").read_text())["map"]
    changed(copy, map={**settings, "activation": {"_target_": "mine_for_test.Halved"}})
    with pytest.raises(NsmError) as refused:
        nsm.load(copy)
    assert (refused.value.kind, refused.value.key) == ("not_trusted", "mine_for_test")
    assert not mine.exists()
    for trust in ("mine_for_test", ["mine_for_test"]):
        phi = nsm.load(copy, trust=trust)
        assert mine.exists() and np.isfinite(phi(np.zeros((1, 2)))).all()


def test_what_is_trusted_now_is_not_taken_from_a_file(copy, mine, here):
    file = copy / "config.yaml"
    settings = yaml.safe_load(file.read_text())
    settings["activation"] = {"_target_": "mine_for_test.Halved"}
    settings["trust"] = ["mine_for_test"]
    file.write_text(yaml.safe_dump(settings))
    refused = here(f"resume={copy}")
    assert refused.returncode == 2 and "mine_for_test" in refused.stderr
    assert not mine.exists()


@pytest.mark.parametrize(
    "line",
    [
        "seed: ${oc.env:HOME}",
        "seed: !!python/object/apply:os.system ['touch sprung']",
        "seed: !!python/name:os.system ''",
        "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]",
        "seed: [1",
        "- a list",
    ],
)
def test_a_stored_configuration_is_only_read(tmp_path, line):
    file = tmp_path / "config.yaml"
    file.write_text(line + "\n")
    with pytest.raises(NsmError) as caught:
        read_config(file)
    assert (caught.value.kind, "\n" in str(caught.value)) == ("damaged_file", False)
    assert not Path("sprung").exists()


def test_a_stored_configuration_makes_nothing_by_target(copy, here):
    file = copy / "config.yaml"
    settings = yaml.safe_load(file.read_text())
    settings["source"] = {"_target_": "os.system", "command": "touch sprung"}
    file.write_text(yaml.safe_dump(settings))
    result = here(f"resume={copy}")
    assert result.returncode == 2 and "os.system" in result.stderr
    assert not Path("sprung").exists()


def test_a_name_is_no_interpolation(tmp_path, here, monkeypatch):
    """A file may be called so; its name must not tell what the environment holds."""
    monkeypatch.setenv("SECRET", "hidden")
    (tmp_path / "${oc.env:SECRET}.obj").write_text("v 0 0 0\n")
    result = here('surface.path="\\${oc.env:SECRET}.obj"')
    assert result.returncode == 2
    assert "hidden" not in result.stderr


def changed(folder: Path, **metadata) -> None:
    """Change entries of surface.json, without its checksum."""
    file = folder / "surface.json"
    content = json.loads(file.read_text())
    content.update(metadata)
    file.write_text(json.dumps(content))


def with_arrays(folder: Path, **arrays) -> None:
    """Replace arrays of surface.safetensors, with the checksum that belongs to it."""
    import hashlib

    file = folder / "surface.safetensors"
    save_file({**load_file(file), **{k.replace("__", "."): v for k, v in arrays.items()}}, file)
    changed(folder, sha256=hashlib.sha256(file.read_bytes()).hexdigest())


@pytest.mark.parametrize(
    "encoding",
    [
        {"_target_": "nsm.maps.SplineGrid", "resolutions": [1_000_000]},
        {"_target_": "nsm.maps.SplineGrid", "resolutions": [4] * 1_000_000},
        {"_target_": "nsm.maps.RandomFourierFeatures", "features": 10**12},
        {"_target_": "nsm.maps.RandomFourierFeatures", "features": 10**9},
        {"_target_": "os.system"},
        "text",
    ],
)
def test_settings_of_a_network_take_no_more_than_its_weights(copy, encoding):
    settings = json.loads((copy / "surface.json").read_text())["map"]
    changed(copy, map={**settings, "encoding": encoding})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(NsmError) as refused:
        nsm.load(copy)
    assert refused.value.kind in ("damaged_file", "not_trusted")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000  # kB


@pytest.mark.parametrize(
    "settings", [{"width": 10**9}, {"depth": 10**9}, {"depth": -1}, {"width": "64"}, {"out_dim": 2}]
)
def test_a_network_that_does_not_fit(copy, settings):
    stored = json.loads((copy / "surface.json").read_text())["map"]
    changed(copy, map={**stored, **settings})
    with pytest.raises(NsmError) as refused:
        nsm.load(copy)
    assert refused.value.kind == "damaged_file"


@pytest.mark.parametrize("map_", [None, [], "x", 3, {}])
def test_a_map_that_is_none(copy, map_):
    changed(copy, map=map_)
    with pytest.raises(NsmError) as refused:
        nsm.load(copy)
    assert refused.value.kind == "damaged_file"


@pytest.mark.parametrize(
    "arrays",
    [
        {"surface__source_vertex": np.array([2**60])},
        {"surface__cut_vertex": np.array([2**60])},
        {"surface__faces": np.array([[0, 1, 10**6]])},
        {"surface__faces": np.zeros((1, 3))},
        {"surface__center": np.array([np.nan, 0, 0])},
        {"surface__uv": np.zeros((0, 2))},
    ],
)
def test_arrays_that_are_no_surface(copy, arrays):
    if {"surface__source_vertex", "surface__cut_vertex"} & set(arrays):
        count = len(load_file(copy / "surface.safetensors")["surface.vertices"])
        arrays = {k: np.repeat(v, count) for k, v in arrays.items()}
    with_arrays(copy, **arrays)
    with pytest.raises(NsmError) as refused:
        nsm.load(copy)
    assert refused.value.kind == "damaged_file"


def test_a_safetensors_header_that_lies(copy):
    import hashlib

    head = json.dumps({"x": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}})
    for length in (len(head), 2**62):
        data = length.to_bytes(8, "little") + head.encode()
        (copy / "surface.safetensors").write_bytes(data)
        changed(copy, sha256=hashlib.sha256(data).hexdigest())
        with pytest.raises(NsmError):
            nsm.load(copy)


def test_folders_without_a_result(finished, copy, tmp_path):
    (tmp_path / "empty").mkdir()
    shutil.copytree(finished, tmp_path / "other" / "deeper")
    for file in ("metrics.json", "surface.json", "surface.safetensors"):
        (copy / file).unlink()
    for folder in (tmp_path, copy, tmp_path / "empty", tmp_path / "other", tmp_path / "not there"):
        with pytest.raises(NsmError) as refused:
            nsm.load(folder)
        assert (refused.value.kind, refused.value.key) == ("missing_file", str(folder))


def test_mistaken_arguments_in_python(tmp_path):
    hemisphere = nsm.Surface.load("hemisphere")
    mistakes = [
        *(
            lambda setting=setting: nsm.overfit(hemisphere, overrides=[*TINY, setting])
            for setting in ("task=param", "surface=cow", "surface.path=a.obj", "source=a.obj")
        ),
        lambda: nsm.overfit(hemisphere, overrides=[*TINY, "domain=square"]),
        lambda: nsm.overfit(hemisphere, overrides="experiment=quick"),
        lambda: nsm.overfit(hemisphere, overrides=["resume=run"]),
        lambda: nsm.map_pair("cone", "saddle", [], overrides=["landmarks=a.json"]),
        lambda: nsm.map_collection(["cone"] * 3, overrides=["surfaces=null"]),
        lambda: nsm.Surface.load(hemisphere),
        lambda: nsm.load(tmp_path / "outputs"),
    ]
    for mistake in mistakes:
        with pytest.raises(NsmError) as refused:
            mistake()
        assert refused.value.kind != "bad_input"


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "mesh.obj")
    with pytest.raises(NsmError) as refused:
        load_mesh(tmp_path / "mesh.obj")
    assert refused.value.kind == "not_a_file"


def test_an_array_that_lies_makes_no_room(tmp_path):
    from nsm.pipeline.attributes import read_attributes

    rows = [1801, 1801]
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**45},), }}".ljust(117) + "\n"
    data = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode()
    files = {"lies.npy": data, "trap.npy": pickle.dumps(Trap(tmp_path / "sprung"))}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(NsmError) as refused:
            read_attributes({"source": str(tmp_path / name), "target": None}, rows)
        assert refused.value.key == "attributes.source"
    assert not (tmp_path / "sprung").exists()
    np.savez(tmp_path / "many.npz", a=np.zeros(3))
    with pytest.raises(NsmError) as refused:
        read_attributes({"source": str(tmp_path / "many.npz"), "target": None}, rows)
    assert refused.value.key == "attributes.source"
