"""Files from strangers: nothing in them is carried out, and none takes more than it has."""

import json
import os
import pickle
import re
import resource
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

import nsm
from nsm.config import read_config
from nsm.errors import NsmError
from nsm.maps import ACTIVATIONS
from nsm.results.files import check_stored
from nsm.surfaces.landmarks import read_landmarks
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
    with pytest.raises(ValueError, match="compressed"):
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
    with pytest.raises(NsmError, match="not a regular file"):
        nsm.load(copy)
    os.mkfifo(copy / "marks.vts")
    with pytest.raises(NsmError, match="not a regular file"):
        read_landmarks(copy / "marks.vts")


def test_only_the_user_can_name_a_module(here, tmp_path, monkeypatch):
    """NSM_PLUGINS is the one way to let the command import code; no setting is."""
    (tmp_path / "mine_for_test.py").write_text(
        "import nsm\nnsm.register_activation('halved', lambda z: z / 2)\n"
    )
    words = ["surface=cone", *TINY, "activation=halved"]
    refused = here(*words)
    assert refused.returncode == 2 and "halved" in refused.stderr
    monkeypatch.setenv("NSM_PLUGINS", "not_there")
    missing = here(*words)
    assert missing.returncode == 2 and len(missing.stderr.strip().splitlines()) == 1
    assert "not_there" in missing.stderr
    monkeypatch.setenv("NSM_PLUGINS", "mine_for_test")
    before = dict(ACTIVATIONS)
    try:
        assert here(*words, "hydra.run.dir=run").returncode == 0
        assert json.loads((tmp_path / "run/surface.json").read_text())["map"]["activation"] == {
            "name": "halved"
        }
        target = here("surface=cone", *TINY, "+activation._target_=os.system")
        assert target.returncode == 2 and "_target_" in target.stderr
    finally:
        ACTIVATIONS.clear()
        ACTIVATIONS.update(before)


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("seed: ${oc.env:HOME}", "interpolations"),
        ("seed: !!python/object/apply:os.system ['touch sprung']", "tags"),
        ("seed: !!python/name:os.system ''", "tags"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]", "anchors"),
        ("seed: [1", "not a configuration"),
        ("- a list", "not a configuration"),
    ],
)
def test_a_stored_configuration_is_only_read(tmp_path, line, word):
    file = tmp_path / "config.yaml"
    file.write_text(line + "\n")
    with pytest.raises(NsmError, match=word) as caught:
        read_config(file)
    assert "\n" not in str(caught.value)
    assert not Path("sprung").exists()


def test_a_stored_configuration_makes_nothing_by_target(copy, here):
    file = copy / "config.yaml"
    trap = "source: {_target_: os.system, command: touch sprung}"
    text = file.read_text().replace("source: null\ntarget: null", f"{trap}\ntarget: null", 1)
    assert trap in text
    file.write_text(text)
    result = here(f"resume={copy}")
    assert result.returncode == 2
    assert "_target_" in result.stderr
    assert not Path("sprung").exists()


def test_a_name_is_no_interpolation(tmp_path, here, monkeypatch):
    """A file may be called so; its name must not tell what the environment holds."""
    monkeypatch.setenv("SECRET", "told")
    (tmp_path / "${oc.env:SECRET}.obj").write_text("v 0 0 0\n")
    result = here('surface.path="\\${oc.env:SECRET}.obj"')
    assert result.returncode == 2
    assert "told" not in result.stderr


def changed(folder: Path, **words) -> None:
    """Change entries of surface.json, and let its checksum stand."""
    file = folder / "surface.json"
    content = json.loads(file.read_text())
    content.update(words)
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
        {"name": "spline_grid", "resolutions": [1_000_000]},
        {"name": "spline_grid", "resolutions": [4] * 10_000_000},
        {"name": "fourier", "features": 10**12},
        {"name": "os.system"},
        "text",
    ],
)
def test_settings_of_a_network_take_no_more_than_its_weights(copy, encoding):
    settings = json.loads((copy / "surface.json").read_text())["map"]
    changed(copy, map={**settings, "encoding": encoding})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(NsmError, match="do not fit|not known here"):
        nsm.load(copy)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000  # kB


@pytest.mark.parametrize(
    "settings", [{"width": 10**9}, {"depth": 10**9}, {"depth": -1}, {"width": "64"}, {"out_dim": 2}]
)
def test_a_network_that_does_not_fit(copy, settings):
    stored = json.loads((copy / "surface.json").read_text())["map"]
    changed(copy, map={**stored, **settings})
    with pytest.raises(NsmError, match="do not fit"):
        nsm.load(copy)


@pytest.mark.parametrize("map_", [None, [], "x", 3, {}])
def test_a_map_that_is_none(copy, map_):
    changed(copy, map=map_)
    with pytest.raises(NsmError, match="do not fit"):
        nsm.load(copy)


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
    with pytest.raises(NsmError, match="do not fit"):
        nsm.load(copy)


def test_a_safetensors_header_that_lies(copy):
    import hashlib

    head = json.dumps({"x": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}})
    for length in (len(head), 2**62):
        data = length.to_bytes(8, "little") + head.encode()
        (copy / "surface.safetensors").write_bytes(data)
        changed(copy, sha256=hashlib.sha256(data).hexdigest())
        with pytest.raises(NsmError):
            nsm.load(copy)


def test_folders_that_hold_no_result(finished, copy, tmp_path):
    with pytest.raises(NsmError, match=rf"folder of 1 run; give it: {re.escape(str(copy))}$"):
        nsm.load(tmp_path)
    shutil.copytree(finished, tmp_path / "other" / "deeper")
    with pytest.raises(NsmError, match="folder of 2 runs; give one of them, for example "):
        nsm.load(tmp_path)
    for file in ("metrics.json", "surface.json", "surface.safetensors"):
        (copy / file).unlink()
    with pytest.raises(NsmError, match=f"not ended; nsm resume={re.escape(str(copy))} goes on"):
        nsm.load(copy)
    (tmp_path / "empty").mkdir()
    with pytest.raises(NsmError, match="no run there"):
        nsm.load(tmp_path / "empty")


def test_mistaken_arguments_in_python(tmp_path):
    hemisphere = nsm.Surface.load("hemisphere")
    with pytest.raises(NsmError, match="give a list of settings"):
        nsm.overfit(hemisphere, overrides="experiment=quick")
    for word in (
        "task=param",
        "surface=cow",
        "surface.path=a.obj",
        "domain=square",
        "source=a.obj",
    ):
        with pytest.raises(NsmError, match=f"overrides: {word}: the function"):
            nsm.overfit(hemisphere, overrides=[*TINY, word])
    with pytest.raises(NsmError, match="landmarks=a.json: the function"):
        nsm.map_pair("cone", "saddle", [], overrides=["landmarks=a.json"])
    with pytest.raises(NsmError, match="surfaces=null: the function"):
        nsm.map_collection(["cone"] * 3, overrides=["surfaces=null"])
    with pytest.raises(NsmError, match="nsm resume=run"):
        nsm.overfit(hemisphere, overrides=["resume=run"])
    with pytest.raises(NsmError, match=r"Surface\.from_arrays"):
        nsm.Surface.load(hemisphere)
    with pytest.raises(NsmError, match="no such folder"):
        nsm.load(tmp_path / "outputs")


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "mesh.obj")
    with pytest.raises(NsmError, match="not a regular file"):
        load_mesh(tmp_path / "mesh.obj")


def test_an_array_that_lies_makes_no_room(tmp_path):
    from nsm.pipeline.attributes import read_attributes

    rows = [1801, 1801]
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({2**45},), }}".ljust(117) + "\n"
    data = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode()
    files = {"lies.npy": data, "trap.npy": pickle.dumps(Trap(tmp_path / "sprung"))}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(NsmError, match="attributes.source"):
            read_attributes({"source": str(tmp_path / name), "target": None}, rows)
    assert not (tmp_path / "sprung").exists()
    np.savez(tmp_path / "many.npz", a=np.zeros(3))
    with pytest.raises(NsmError, match="archive"):
        read_attributes({"source": str(tmp_path / "many.npz"), "target": None}, rows)
