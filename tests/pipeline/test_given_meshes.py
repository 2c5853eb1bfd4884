"""All functions take files, objects of trimesh, arrays and surfaces, and can be silent."""

import numpy as np
import pytest
from tiny import TRAINING

import nsm
from nsm.surfaces.catalogue import catalogue_mesh

# without the surface and the progress bar, which the arguments set
TINY = [word for word in TRAINING if not word.startswith(("surface.path", "trainer.progress"))]


@pytest.fixture(scope="module")
def patch():
    return catalogue_mesh("hemisphere")


def test_overfit_takes_arrays_as_it_takes_their_surface(patch, capfd):
    one = nsm.overfit(patch, overrides=TINY, progress=False)
    assert capfd.readouterr() == ("", "")
    surface = nsm.Surface.from_arrays(*patch, parameterization="tutte")
    other = nsm.overfit(surface, overrides=TINY, progress=False)
    assert np.array_equal(one.surface.vertices, other.surface.vertices)
    assert one.metrics["rms_percent"] == pytest.approx(other.metrics["rms_percent"])


def test_a_surface_that_has_not_come_near_its_mesh_says_so(patch, tmp_path, capfd):
    """In what is printed, and where figures are kept; so does a flattening that is made from it."""
    far = [*TINY, "initialization=random", "trainer.max_steps=1"]
    phi = nsm.overfit(patch, overrides=far, folder=tmp_path / "far")
    assert phi.metrics["rms_percent"] > 1
    assert "% of the diagonal off the mesh" in capfd.readouterr().out
    assert "off the mesh" in (tmp_path / "far" / "metrics.json").read_text()

    words = [word for word in TINY if not word.startswith("encoding")]
    nsm.parameterize(phi, overrides=words)
    assert "% of the diagonal off the mesh" in capfd.readouterr().out


def test_parameterize_and_map_pair_take_arrays_and_surfaces(patch, capfd):
    words = [*TINY, "phi.overrides=[" + ",".join(f"'{word}'" for word in TINY) + "]"]
    words = [word for word in words if not word.startswith("encoding")]  # h is a spline
    flat = nsm.parameterize(patch, overrides=words, progress=False)
    assert flat.uv.shape[1] == 2
    surface = nsm.Surface.from_arrays(*patch, name="raw")
    f = nsm.map_pair(surface, patch, overrides=words, progress=False)
    assert np.array_equal(f.source.surface.vertices, surface.vertices)
    assert f.source.surface.name == "raw"
    assert capfd.readouterr() == ("", "")


def test_a_surface_keeps_its_raw_mesh(patch, tmp_path, monkeypatch):
    monkeypatch.setenv("NSM_CACHE", str(tmp_path))
    for _ in range(2):  # made, and from the cache
        surface = nsm.Surface.from_arrays(*patch, cache=True)
        again = nsm.Surface.from_arrays(*surface.raw)
        assert np.array_equal(again.uv, surface.uv)
