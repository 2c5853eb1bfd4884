"""experiment=fast: maps by quasi-Newton steps, as users run them."""

import json

import numpy as np
import pytest
import torch

import nsm
from nsm.config import compose_config
from nsm.energies import first_fundamental_form, symmetric_dirichlet
from nsm.maps import Composition, build_analytic
from nsm.pipeline import run_task
from nsm.pipeline.task import Given
from nsm.results import NeuralSurface
from nsm.surfaces.shapes import ring_mesh
from tests.interruption import interrupted
from tests.tiny import dome

WORDS = [
    "task=pair_map",
    "domain=disc",
    "experiment=fast",
    "map.cells=16",
    "optimizer.levels=[8,16]",
    "optimizer.steps=[2]",
    "data.points=[1024,4096]",
    "data.steps_per_epoch=2",
    "data.held_out=256",
    "trainer.tabulated=64",
    "trainer.max_steps=4",
    "trainer.progress=false",
    "artefacts=false",
    "logger=none",
]


@pytest.fixture(scope="module")
def surfaces():
    """A flat and a steep paraboloid."""
    return [
        NeuralSurface(
            dome(height, 12),
            build_analytic({"name": "paraboloid", "curvature": -height}),
            {"rms_percent": 0.0},
            {},
        )
        for height in (0.1, 1.2)
    ]


MARKS = [[5, 5], [100, 100], [200, 201], [300, 300]]


def run(surfaces, folder, *words, marks=MARKS, **extra):
    phi, psi = surfaces
    given = Given(source=phi, target=psi, landmarks=marks)
    return run_task(compose_config([*WORDS, *words]), folder, given, **extra)


def energy(f):
    """The mean energy of a map between the paraboloids, by area of the source."""
    uv = torch.as_tensor(ring_mesh(30)[0], dtype=torch.float32)
    source = first_fundamental_form(f.source.map.value_and_jacobian(uv)[1])
    jacobian = Composition(f.target.map, f.map).value_and_jacobian(uv)[1]
    share = torch.linalg.det(source).sqrt()
    values = symmetric_dirichlet(source, first_fundamental_form(jacobian))
    return float((share * values).sum() / share.sum())


def test_quasi_newton_steps_lower_the_energy(surfaces, tmp_path):
    few = ["trainer.max_steps=1", "optimizer.iterations=1"]
    start = run(surfaces, tmp_path / "few", *few, marks=None)
    end = run(surfaces, tmp_path / "more", marks=None)
    assert 3.98 < energy(end) < energy(start) - 0.01


def test_quasi_newton_steps_meet_the_landmarks(surfaces, tmp_path):
    f = run(surfaces, tmp_path / "run", "trainer.max_steps=8")
    assert f.metrics["landmark_error_max_percent"] < 0.1
    assert f.certificate["certified"]
    summary = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert summary["steps"] == 8 and not summary["faults"]["rollbacks"]


def test_an_interrupted_fast_map_ends_at_the_same_result(surfaces, tmp_path):
    whole = run(surfaces, tmp_path / "whole")
    with interrupted(at=2):
        run(surfaces, tmp_path / "parted")
    resumed = run(surfaces, tmp_path / "parted", resuming=True)
    assert np.array_equal(resumed.image_uv, whole.image_uv)


def test_a_stored_fast_map_is_loaded_again(surfaces, tmp_path):
    f = run(surfaces, tmp_path / "run")
    again = nsm.load(tmp_path / "run")
    uv = torch.as_tensor(f.source.surface.uv[:50], dtype=torch.float32)
    assert torch.equal(again.map(uv), f.map(uv))


def small(task, *words):
    return compose_config(
        [f"task={task}", *(w for w in WORDS if not w.startswith("task=")), *words]
    )


def test_a_fast_flattening_lowers_the_energy(surfaces, tmp_path):
    words = ["trainer.max_steps=3", "certification.rounds=0"]
    f = run_task(small("param", *words), tmp_path / "run", Given(phi=surfaces[1]))
    uv = torch.as_tensor(surfaces[1].surface.uv, dtype=torch.float32)
    source = first_fundamental_form(surfaces[1].map.value_and_jacobian(uv)[1])
    flat = first_fundamental_form(f.map.value_and_jacobian(uv)[1])
    before = symmetric_dirichlet(source, torch.eye(2).expand_as(source)).mean()
    after = symmetric_dirichlet(source, flat).mean()
    assert f.certificate["certified"]
    assert 3.98 < float(after) < float(before) - 0.01


def values_of(figures, name):
    """All values under a name in nested dictionaries."""
    inner = [values_of(v, name) for v in figures.values() if isinstance(v, dict)]
    return [v for values in inner for v in values] + [v for k, v in figures.items() if k == name]


def test_a_fast_collection_meets_its_landmarks(surfaces, tmp_path):
    marks = [list(each) for each in zip(*[(a, b, a) for a, b in MARKS], strict=True)]
    given = Given(surfaces=[*surfaces, surfaces[0]], landmarks=marks)
    f = run_task(small("collection_map", "trainer.max_steps=6"), tmp_path / "run", given)
    assert f.certificate["certified"]
    errors = values_of(f.metrics, "landmark_error_max_percent")
    assert errors and max(errors) < 0.2


@pytest.mark.parametrize("task", ["pair_map", "param", "collection_map"])
def test_a_preview_is_the_fast_way_on_coarse_levels(task):
    fast, preview = (
        compose_config([f"task={task}", f"experiment={e}"]) for e in ("fast", "preview")
    )
    assert (
        preview.constraints == fast.constraints
        and preview.optimizer._target_ == fast.optimizer._target_
    )
    assert preview.trainer.max_steps < fast.trainer.max_steps
    assert max(preview.data.points) < max(fast.data.points)
    assert list(preview.data.steps) == list(preview.optimizer.steps)


@pytest.mark.parametrize("task", ["pair_map", "collection_map", "param"])
def test_a_fast_run_has_a_validation_curve_of_several_points(task):
    config = compose_config([f"task={task}", "experiment=fast"])
    assert config.trainer.max_steps >= 2 * config.data.steps_per_epoch
    assert config.trainer.log_every == 1


@pytest.mark.parametrize("task", ["overfit", "pair_map", "collection_map", "param"])
@pytest.mark.parametrize("words", [[], ["experiment=adam"], ["experiment=quick"]])
def test_every_run_has_a_validation_curve_of_several_points(task, words):
    if task == "overfit" and words == ["experiment=adam"]:
        return  # of maps
    config = compose_config([f"task={task}", *words])
    assert config.trainer.max_steps >= 2 * config.data.steps_per_epoch


def collection_of(surfaces, folder, **extra):
    """The default training of three surfaces, in few steps; the third lacks the last landmark."""
    settings = [
        "task=collection_map",
        *(w for w in WORDS if w.startswith(("domain=", "trainer.prog", "artef", "logger"))),
        *("map.cells=8", "data.batch_size=256", "data.steps_per_epoch=1", "data.held_out=256"),
        *("trainer.tabulated=64", "trainer.max_steps=4", "constraints.triangles_from=0.5"),
        *("optimizer.iterations=6", "certification.rounds=0"),
    ]
    first, second = (list(each) for each in zip(*MARKS, strict=True))
    given = Given(surfaces=[*surfaces, surfaces[0]], landmarks=[first, second, [*first[:-1], -1]])
    return run_task(compose_config(settings), folder, given, **extra)


def test_a_collection_meets_its_landmarks_and_resumes_between_turns(surfaces, tmp_path):
    whole = collection_of(surfaces, tmp_path / "whole")
    assert whole.certificate["certified"]
    assert max(values_of(whole.metrics, "landmark_error_max_percent")) < 0.1
    with interrupted(at=3):
        collection_of(surfaces, tmp_path / "parted")
    resumed = collection_of(surfaces, tmp_path / "parted", resuming=True)
    for h, again in zip(whole.maps, resumed.maps, strict=True):
        assert all(torch.equal(w, again.state_dict()[key]) for key, w in h.state_dict().items())
