"""The neural surfaces of maps: made as the map is, and kept where that is safe."""

import io

import pytest
import torch
from rich.console import Console
from tiny import dome

from nsm.config import compose_config
from nsm.pipeline import surface_cache
from nsm.pipeline.surface_cache import cached_surfaces

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
