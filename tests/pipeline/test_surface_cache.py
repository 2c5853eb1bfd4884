"""The neural surfaces of maps: made as the map is, and kept where that is safe."""

import io

import pytest
import torch
from rich.console import Console
from tiny import dome

from nsm.config import compose_config
from nsm.domains import Disc
from nsm.errors import NsmError
from nsm.pipeline import surface_cache
from nsm.pipeline.surface_cache import cached_surfaces
from nsm.pipeline.training import plain

SMALL = ["experiment=quick", "trainer.max_steps=2", "data.held_out=64", "data.batch_size=64"]
SMALL += ["encoding.resolutions=[4]", "map.width=8"]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NSM_CACHE", str(tmp_path))


@pytest.fixture(scope="module")
def surface():
    return dome(0.4, 4)


def made(surface, *overrides, words=()):
    """The neural surface that a map with these settings needs, and whether it was in the cache."""
    config = compose_config(["task=pair_map", "trainer.progress=false", *words])
    config.phi.overrides = [*SMALL, *overrides]
    printed = io.StringIO()
    (phi,) = cached_surfaces([surface], config, Console(file=printed, width=200))
    return phi, "from the cache" in printed.getvalue()


def test_the_hardware_of_the_map_reaches_its_surfaces(surface, monkeypatch):
    seen = []
    prepared = surface_cache.run_prepared

    def look(task, run, started):
        seen.append(run.config.trainer)
        return prepared(task, run, started)

    monkeypatch.setattr(surface_cache, "run_prepared", look)
    words = ["trainer.accelerator=cpu", "trainer.precision=tf32", "trainer.threads=null"]
    made(surface, words=words)
    (trainer,) = seen
    assert (trainer.accelerator, trainer.precision, trainer.devices) == ("cpu", "tf32", 1)
    assert trainer.threads is None and trainer.progress is False


def test_hardware_and_logs_make_no_other_surface(surface):
    assert not made(surface)[1]
    for words in (["trainer.accelerator=cpu"], ["trainer.threads=2"]):
        assert made(surface, words=words)[1]
    assert made(surface, "trainer.log_every=3")[1]
    assert not made(surface, "map.width=4")[1]


class Mine(torch.nn.Module):
    power = 2

    def __init__(self) -> None:
        super().__init__()

    def forward(self, z):
        return z.sigmoid() ** self.power


def test_what_depends_on_a_users_code_is_made_anew(surface, monkeypatch):
    """The code may have changed, under the same name."""
    own = f"activation._target_={__name__}.Mine"
    first, _ = made(surface, own, "initialization=random")
    monkeypatch.setattr(Mine, "power", 3)
    second, cached = made(surface, own, "initialization=random")
    assert not cached
    x = torch.rand(5, 2)
    assert not torch.equal(first.map(x), second.map(x))


def steps_of(*words, overrides=()):
    """Steps of the trainings of a map's neural surfaces, and where the cache has one of them."""
    config = compose_config(["task=pair_map", *words])
    config.phi.overrides = [*overrides]
    overfit = surface_cache._overfit_config(config, Disc())
    return overfit.trainer.max_steps, surface_cache._folder_of(dome(0.4, 4), plain(overfit)).name


def test_maps_take_the_fit_alone():
    choices = ([], ["phi.steps=50"], ["phi.steps=null"])
    alone, few, whole = (steps_of(*words) for words in choices)
    assert alone[0] == 0 and few[0] == 50
    assert whole[0] == compose_config(["task=overfit"]).trainer.max_steps > 50
    assert len({alone[1], few[1], whole[1]}) == 3  # apart in the cache
    assert steps_of(overrides=["trainer.max_steps=70"])[0] == 70


@pytest.mark.parametrize("choice", ["initialization=random", "encoding=fourier", "map=residual"])
def test_without_a_fit_there_is_a_whole_training(choice):
    whole = compose_config(["task=overfit", choice])
    fitted = whole.map.get("linear_skip") == "fitted"
    steps = steps_of(overrides=[choice])[0]
    assert steps == (0 if fitted else whole.trainer.max_steps)


def test_side_by_side_is_as_one_after_the_other(tmp_path, monkeypatch):
    surfaces = [dome(0.4, 4), dome(0.7, 5)]
    phis, told = [], []
    for processes in (1, 2):
        monkeypatch.setenv("NSM_CACHE", str(tmp_path / str(processes)))
        words = ["task=pair_map", f"phi.processes={processes}", "trainer.accelerator=cpu"]
        config = compose_config([*words, "trainer.progress=false"])
        config.phi.overrides = ["encoding.resolutions=[4,8]", "trainer.max_steps=3", *SMALL[2:4]]
        printed = io.StringIO()
        phis.append(cached_surfaces(surfaces, config, Console(file=printed, width=200)))
        told.append(printed.getvalue())
    for one, other, surface in zip(*phis, surfaces, strict=True):
        assert other.metrics == one.metrics and other.surface is surface
        weights = one.map.state_dict()
        assert all(torch.equal(weights[key], v) for key, v in other.map.state_dict().items())
    for text in told:
        assert [f"{s.name}: neural surface in" in text for s in surfaces] == [True, True]
        assert "from the cache" not in text


def test_bad_settings_are_told_from_another_process(surface):
    config = compose_config(["task=pair_map", "phi.processes=2", "trainer.accelerator=cpu"])
    config.phi.overrides = [*SMALL, "encoding.features=2"]  # too few for the fit
    with pytest.raises(NsmError) as error:
        cached_surfaces([surface, dome(0.7, 5)], config, Console(quiet=True))
    assert error.value.kind == "not_instantiable"
