"""Maps that a training leaves folded: repaired, or reported as such."""

import json

import numpy as np
import pytest
from rich.console import Console

import nsm
from nsm.config import compose_config
from nsm.domains import Disc
from nsm.errors import NsmError
from nsm.pipeline import Task, certification
from nsm.results.analytic import analytic_surface
from nsm.results.divergence_guard import DivergenceGuard
from nsm.results.progress import TrainingProgress
from nsm.surfaces.shapes import ring_mesh

QUICK = ["experiment=quick", "data.held_out=512", "trainer.threads=1"]

CROSSED = [[0.5, 0.0], [-0.5, 0.1], [0.0, 0.5], [0.1, -0.6]]  # swapped in pairs: a half turn inside
# the settings of experiment=adam beside experiment=quick
FORCED = ["map=planar", "encoding=planar_grid", "optimizer=adam_planar"]
FORCED += ["constraints=adam_pair_map", "loss_weights=adam_pair_map"]
FORCED += ["encoding.resolutions=[16,64]", "sampler=fresh", "trainer.tabulated=null"]
FORCED += ["constraints.ramp=0", "loss_weights.triangles=0", "loss_weights.seam=0"]
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


def test_a_map_that_flips_is_repaired(ends, tmp_path):
    _, told = forced(ends, tmp_path / "plain", "certification.repair=false")
    assert told["certified"] is False and told["flipped_triangles"] > 0
    assert told["flipped_triangles"] == told["before_repair"]["flipped_triangles"]
    (warning,) = [line for line in told["warnings"] if "NOT certified" in line]
    assert "Correct or leave out landmark" in warning and "thinner" not in warning
    f, repaired = forced(ends, tmp_path / "repaired")
    assert repaired["certified"] is True and repaired["flipped_triangles"] == 0
    assert repaired["before_repair"] == told["before_repair"]
    assert not any("NOT certified" in line for line in repaired["warnings"])
    assert f.metrics["flipped_percent"] == 0 and f.metrics["certified"] is True
    share = 100 * told["before_repair"]["flipped_triangles"] / len(ends[0].surface.faces)
    assert f.metrics["flipped_before_repair_percent"] == pytest.approx(share)
    assert nsm.load(tmp_path / "repaired").certificate["certified"]


def test_where_moving_vertices_is_not_enough_training_goes_on(ends, tmp_path, monkeypatch):
    monkeypatch.setattr(nsm.SurfaceMap, "repaired", lambda self: self)
    monkeypatch.setattr(certification, "_SHARE", 1)  # as many steps again
    _, short = forced(ends, tmp_path / "short", "certification.rounds=0")
    _, long = forced(ends, tmp_path / "long", "certification.rounds=2")
    assert short["rounds"] == 0 and not short["certified"]
    assert 1 <= long["rounds"] <= 2
    assert long["flipped_triangles"] < long["before_repair"]["flipped_triangles"]


class Found:
    """A result with so many faults, which its repair lowers."""

    def __init__(self, flips, overlaps=0, mended=0):
        self.flips, self.overlaps, self.mended = flips, overlaps, mended

    @property
    def certificate(self):
        return {
            "certified": self.flips == self.overlaps == 0,
            "flipped_triangles": self.flips,
            "boundary_self_intersections": self.overlaps,
        }

    def repaired(self):
        return Found(self.flips - self.mended, self.overlaps)


class Scripted(Task):
    """A task whose rounds end in these results, one after the other."""

    def __init__(self, *results, rounds=2):
        super().__init__()
        words = [*QUICK, f"certification.rounds={rounds}"]
        self.setup(compose_config(["task=param", *words]), Console(quiet=True))
        self.results = list(results)

    def make_result(self, module):
        return self.results.pop(0)


@pytest.fixture
def trainings(monkeypatch):
    made = []
    monkeypatch.setattr(certification, "_train_on", lambda *_: made.append(1))
    return made


def test_the_best_round_is_returned_not_the_last(trainings):
    task = Scripted(Found(9), Found(4, mended=1), Found(7))
    best, figures = certification.certified(task, None, None)
    assert best.flips == figures["flipped_triangles"] == 3
    assert figures["rounds"] == len(trainings) == 2
    assert figures["before_repair"]["flipped_triangles"] == 9


def test_a_round_that_leaves_as_many_faults_is_the_last(trainings):
    task = Scripted(Found(9, mended=2), Found(8, mended=1), Found(0), rounds=4)
    best, figures = certification.certified(task, None, None)
    assert best.flips == 7 and not figures["certified"]
    assert figures["rounds"] == len(trainings) == 1 and len(task.results) == 1


def test_a_boundary_that_overlaps_itself_spends_no_rounds(trainings):
    best, figures = certification.certified(Scripted(Found(2, overlaps=3, mended=2)), None, None)
    assert (best.flips, best.overlaps) == (0, 3) and not figures["certified"]
    assert figures["rounds"] == len(trainings) == 0


def test_further_trainings_are_guarded_and_a_failure_keeps_what_there_is(monkeypatch):
    seen = []

    def no_trainer(config, callbacks, **_):
        seen.extend(callbacks)
        raise NsmError("the loss is not finite", kind="not_finite")

    class Module:
        progress_figure, progress_form = "val/distortion", "{:.3f}"

        def strengthen(self, steps):
            assert steps >= 1

    monkeypatch.setattr(certification, "lightning_trainer", no_trainer)
    best, _ = certification.certified(Scripted(Found(5, mended=1)), Module(), None)
    assert best.flips == 4 and [type(c) for c in seen] == [DivergenceGuard, TrainingProgress]
