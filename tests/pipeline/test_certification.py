"""Maps that a training leaves folded: repaired, or reported as such."""

import json

import numpy as np
import pytest

import nsm
from nsm.domains import Disc
from nsm.pipeline import certification
from nsm.results.analytic import analytic_surface
from nsm.surfaces.shapes import ring_mesh

QUICK = ["experiment=quick", "data.held_out=512", "trainer.threads=1"]

CROSSED = [[0.5, 0.0], [-0.5, 0.1], [0.0, 0.5], [0.1, -0.6]]  # swapped in pairs: a half turn inside
FORCED = ["constraints.ramp=0", "loss_weights.triangles=0", "loss_weights.seam=0"]
FORCED += ["loss_weights.injectivity=0", "loss_weights.landmarks=1.0e+4"]
FORCED += ["trainer.gradient_clip=null", "optimizer.lr=0.01", "trainer.max_steps=80"]


@pytest.fixture
def ends(monkeypatch):
    monkeypatch.setattr(Disc, "mesh", lambda self, rings=12: ring_mesh(rings))
    return [analytic_surface({"name": name}, Disc()) for name in ("plane", "paraboloid")]


def forced(ends, folder, *words):
    """A map that its few steps leave folded, and what metrics.json says of it."""
    uv = ends[0].surface.uv
    ids = [int(np.linalg.norm(uv - p, axis=1).argmin()) for p in CROSSED]
    pairs = [[ids[k], ids[j]] for k, j in enumerate((1, 0, 2, 3))]
    f = nsm.map_pair(
        *ends,
        pairs,
        overrides=[*QUICK, *FORCED, "artefacts=false", "logger=none", *words],
        folder=folder,
        progress=False,
    )
    return f, json.loads((folder / "metrics.json").read_text())


def test_a_map_that_flips_is_repaired_and_says_so(ends, tmp_path, capsys):
    _, told = forced(ends, tmp_path / "plain", "certification.repair=false")
    assert told["certified"] is False and told["flipped_triangles"] > 0
    assert told["flipped_triangles"] == told["before_repair"]["flipped_triangles"]
    assert "NOT certified" in capsys.readouterr().out
    f, repaired = forced(ends, tmp_path / "repaired")
    assert repaired["certified"] is True and repaired["flipped_triangles"] == 0
    assert repaired["before_repair"] == told["before_repair"]
    assert f.metrics["flipped_percent"] == 0 and f.metrics["certified"] is True
    assert nsm.load(tmp_path / "repaired").certificate["certified"]


def test_where_moving_vertices_is_not_enough_training_goes_on(ends, tmp_path, monkeypatch):
    monkeypatch.setattr(nsm.SurfaceMap, "repaired", lambda self: self)
    monkeypatch.setattr(certification, "_SHARE", 1)  # as many steps again
    _, short = forced(ends, tmp_path / "short", "certification.rounds=0")
    _, long = forced(ends, tmp_path / "long", "certification.rounds=2")
    assert short["rounds"] == 0 and not short["certified"]
    assert 1 <= long["rounds"] <= 2
    assert long["flipped_triangles"] < long["before_repair"]["flipped_triangles"]
