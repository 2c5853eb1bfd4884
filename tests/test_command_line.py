"""What users write becomes the settings that they mean."""

import pytest
import yaml
from tiny import results

import nsm
from nsm.command_line import prepared_overrides, with_task
from nsm.errors import NsmError

AWKWARD = ["a b.obj", "a (1).obj", "a=b.obj", "a,b.obj", "[a].obj", "{a}.obj", "é'x.obj", '"q".obj']


def settings_of(result):
    assert result.returncode == 0, result.stderr
    return yaml.safe_load(result.stdout)


def test_the_bare_command_is_a_short_help(here):
    result = here()
    assert result.returncode == 0
    assert len(result.stdout.splitlines()) < 20
    assert "pair_map" in result.stdout


@pytest.mark.parametrize("name", AWKWARD)
@pytest.mark.parametrize("form", ["{}", "surface={}", "surface.path={}"])
def test_any_file_name_is_taken_as_it_is(name, form, here, tmp_path):
    (tmp_path / name).touch()
    given = settings_of(here("--cfg", "job", form.format(name)))
    assert given["surface"]["path"] == name


@pytest.mark.parametrize("key", ["source", "target", "landmarks"])
@pytest.mark.parametrize("name", AWKWARD)
def test_files_of_maps_are_taken_as_they_are(key, name, here, tmp_path):
    (tmp_path / name).touch()
    assert settings_of(here("--cfg", "job", "task=pair_map", f"{key}={name}"))[key] == name


def test_tilde_is_the_home_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    mesh = f"{tmp_path}/a.obj"
    assert prepared_overrides(["~/a.obj"]) == [f"surface.path={mesh}"]
    assert prepared_overrides(["surface=~/a.obj"]) == [f"surface.path={mesh}"]
    assert prepared_overrides(["source=~/a.obj"]) == [f"source={mesh}"]
    assert prepared_overrides(["surfaces=[~/a.obj,b.obj]"]) == [f"surfaces=[{mesh},b.obj]"]
    assert prepared_overrides(["~optimizer"]) == ["~optimizer"]


def test_paths_too_long_for_the_names_of_settings():
    """The longest name that a disk takes is too long with what a setting's file adds."""
    mesh = "m" * 251 + ".obj"
    assert prepared_overrides([mesh]) == [f"surface.path={mesh}"]
    assert prepared_overrides([f"source={mesh}"]) == [f"source={mesh}"]


def test_a_task_and_its_surfaces(here, tmp_path):
    (tmp_path / "b (2).obj").touch()
    given = settings_of(here("--cfg", "job", "pair_map", "a.obj", "b (2).obj", "c.json", "seed=3"))
    assert [given[k] for k in ("source", "target", "landmarks", "seed")] == [
        "a.obj",
        "b (2).obj",
        "c.json",
        3,
    ]
    assert given["task"]["name"] == "pair_map"
    given = settings_of(here("--cfg", "job", "collection_map", "cow", "a.obj", "b (2).obj"))
    assert given["surfaces"] == ["cow", "a.obj", "b (2).obj"]
    given = settings_of(here("--cfg", "job", "param", "cow"))
    assert (given["task"]["name"], given["surface"]["name"]) == ("param", "cow")
    given = settings_of(here("--cfg", "job", "param", "."))
    assert given["phi"]["path"] == "."


@pytest.mark.parametrize(
    "words",
    [
        ["a.obj", "b.obj"],
        ["pair_map", "a.obj", "b.obj", "c.obj"],
        ["overfit", "cow", "terrain"],
        ["overfit", "cow", "a.json"],
        ["pair_map", "cow", "terrain", "a.json", "b.json"],
    ],
)
def test_more_surfaces_than_a_task_takes_are_refused(words):
    with pytest.raises(NsmError) as caught:
        with_task(words)
    assert (caught.value.kind, caught.value.key) == ("wrong_inputs", words[0])


def test_words_without_a_task_stay():
    for words in ([], ["a.obj"], ["surface=cow", "seed=1"]):
        assert with_task(words) == words


@pytest.mark.parametrize(
    ("device", "accelerator"), [("cuda", "gpu"), ("gpu", "gpu"), ("cpu", "cpu"), ("auto", "auto")]
)
def test_device(device, accelerator, here):
    given = settings_of(here("--cfg", "job", f"device={device}"))
    assert given["trainer"]["accelerator"] == accelerator


def test_an_unknown_device_is_refused(here):
    with pytest.raises(NsmError) as caught:
        prepared_overrides(["device=tpu"])
    assert (caught.value.kind, caught.value.key) == ("unknown_option", "device")


def test_a_missing_gpu_is_told_before_the_preparation(monkeypatch):
    from pytorch_lightning.accelerators import CUDAAccelerator, MPSAccelerator

    monkeypatch.setattr(CUDAAccelerator, "auto_device_count", lambda: 0)
    monkeypatch.setattr(MPSAccelerator, "is_available", lambda: False)
    with pytest.raises(NsmError) as caught:
        nsm.map_pair("no such file.obj", "nor this.obj", device="cuda")
    assert (caught.value.kind, caught.value.key) == ("no_such_device", "trainer.accelerator")


def test_a_result_is_moved_to_no_gpu_that_is_missing(monkeypatch):
    from pytorch_lightning.accelerators import CUDAAccelerator

    from nsm.results.devices import as_device

    for count, given, kind in (
        (0, "cuda", "no_such_device"),
        (0, "gpu", "no_such_device"),
        (1, "cuda:1", "no_such_device"),
        (1, "tpu 3", "unknown_option"),
    ):
        monkeypatch.setattr(CUDAAccelerator, "auto_device_count", lambda count=count: count)
        with pytest.raises(NsmError) as caught:
            as_device(given)
        assert (caught.value.kind, caught.value.key) == (kind, "device")
    assert (as_device("cuda").type, as_device("cpu").type) == ("cuda", "cpu")
    monkeypatch.setattr(CUDAAccelerator, "auto_device_count", lambda: 0)
    pair = results(rings=3).pair
    for one in (pair, pair.source):
        with pytest.raises(NsmError) as caught:
            one.to("cuda")
        assert caught.value.kind == "no_such_device"


def test_version_and_names(here):
    assert here("--version").stdout.split() == ["nsm", nsm.__version__]
    assert {*nsm.__all__, "__version__"} <= set(dir(nsm))
    assert not [name for name in dir(nsm) if not hasattr(nsm, name)]
