"""Sweeps as users run them: failures stay alone, what is complete is not done again."""

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from tiny import TRAINING

from hydra_plugins.nsm_sweeps.launchers import run_in_process
from nsm.config import compose_config, conf_folder
from nsm.sweeps import job_folder, overrides_of, sweep_folder

TINY = [*TRAINING, "data.steps_per_epoch=4", "logger=none"]


SQUARE = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"


@pytest.fixture(autouse=True)
def patch(tmp_path):
    """The smallest surface: sweeps are tested, not trainings."""
    (tmp_path / "patch.off").write_text(SQUARE)


def jobs(folder: Path) -> dict[str, Path]:
    """The job folders of the one sweep there, by their names without the hash."""
    (sweep,) = (folder / "outputs" / "overfit").iterdir()
    return {place.name.rpartition("-")[0]: place for place in sweep.iterdir() if place.is_dir()}


def times(places: dict[str, Path]) -> dict[str, int]:
    return {name: (place / "metrics.json").stat().st_mtime_ns for name, place in places.items()}


def test_one_bad_job_and_the_same_sweep_again(tmp_path, here):
    (tmp_path / "bad.off").write_text("not a mesh")
    words = ["-m", *TINY, "surface.path=patch.off,bad.off", "seed=0"]
    result = here(*words)
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert "surface.path=bad.off" in line
    first = jobs(tmp_path)
    assert set(first) == {"path_patch.off", "path_bad.off"}
    bad = first.pop("path_bad.off")
    assert {file.name for file in bad.iterdir()} - {".lock"} == {"error.txt"}
    before = times(first)

    (tmp_path / "bad.off").write_text(SQUARE)
    result = here(*words)
    assert result.returncode == 0, result.stderr
    assert not (bad / "error.txt").exists()
    assert times(first) == before


def test_what_an_interruption_left_is_gone_on_with(tmp_path, here):
    words = ["-m", *TINY, "seed=0,1"]
    assert here(*words).returncode == 0
    places = jobs(tmp_path)
    before = times(places)
    (places["seed_0"] / "metrics.json").unlink()
    result = here(*words, "seed=0,1,2")  # wider: the same folder
    assert result.returncode == 0, result.stderr
    after = times(jobs(tmp_path))
    assert set(after) == {"seed_0", "seed_1", "seed_2"}
    assert after["seed_1"] == before["seed_1"]
    # resumed at its last checkpoint, no step was left to do
    steps = json.loads((places["seed_0"] / "metrics.json").read_text())
    assert steps["steps"] == 4


def test_jobs_in_one_batch(tmp_path, here):
    result = here("-m", *TINY, "hydra/launcher=batched", "seed=0,1")
    assert result.returncode == 0, result.stderr
    told = [json.loads((place / "metrics.json").read_text()) for place in jobs(tmp_path).values()]
    assert [figures["batched"] for figures in told] == [2, 2]


def test_settings_of_all_jobs_are_checked_before_the_first_starts(tmp_path, here):
    result = here("-m", *TINY, "activation.beta=1,soft")
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert "activation.beta=soft" in result.stderr
    assert not [p for p in (tmp_path / "outputs").rglob("*") if p.is_file()]
    result = here("-m", *TINY, "activation.bta=1,2")
    assert (result.returncode, "beta" in result.stderr) == (2, True)


@pytest.mark.parametrize(
    ("words", "package"),
    [
        ("hydra/launcher=joblib seed=0,1", "joblib"),
        ("hydra/launcher=submitit seed=0,1", "submitit"),
        ("hydra/launcher=ray seed=0,1", "ray"),
        ("hydra/sweeper=optuna seed=0,1", "optuna"),
    ],
)
def test_a_missing_extra_is_named(tmp_path, here, monkeypatch, words, package):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    result = here("-m", *TINY, *words.split())
    assert result.returncode == 2
    assert f"nsm[{package}]" in result.stderr


def test_joblib_runs_jobs_in_other_processes(tmp_path, here):
    pytest.importorskip("joblib")
    # one job: every process takes seconds to import what trains
    words = ["-m", *TINY, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=3"]
    result = here(*words)
    assert result.returncode == 0, result.stderr
    assert "1 complete" in result.stdout
    assert "results in" not in result.stdout
    (log,) = tmp_path.rglob("log.txt")
    assert "results in" in log.read_text()


def test_a_process_tells_why_its_job_failed(tmp_path, monkeypatch, capfd):
    (tmp_path / "bad.off").write_text("not a mesh")
    monkeypatch.chdir(tmp_path.parent)
    config = compose_config([*TINY, "surface.path=bad.off"])
    place = tmp_path / "job"
    place.mkdir()
    told = run_in_process(place, OmegaConf.to_container(config), str(place), str(tmp_path))
    assert told[0] == place and told[1] is not None and "bad.off" in told[1]
    assert told[1] in (place / "error.txt").read_text()
    assert capfd.readouterr().out == ""


def test_optuna_goes_on_and_names_the_best(tmp_path, here):
    pytest.importorskip("optuna")
    words = ["-m", *TINY, "hydra/sweeper=optuna", "optimizer.lr=tag(log, interval(1e-4, 1e-1))"]
    for trials in (2, 3):
        result = here(*words, f"hydra.sweeper.n_trials={trials}")
        assert result.returncode == 0, result.stderr
        assert len(jobs(tmp_path)) == trials
    figures = {
        place.name: json.loads((place / "metrics.json").read_text())["metrics"]["rms_percent"]
        for place in jobs(tmp_path).values()
    }
    (file,) = tmp_path.rglob("best.json")
    best = json.loads(file.read_text())
    assert best["value"] == min(figures.values()) == figures[best["folder"]]
    result = here(*words, "hydra.sweeper.n_trials=4", "hydra.sweeper.objective=metrics.rms_percnt")
    assert result.returncode == 2
    assert "metrics.rms_percent" in result.stderr


def test_presets_sweep_what_they_say():
    import yaml

    for file in sorted((conf_folder() / "sweep").glob("*.yaml")):
        params = yaml.safe_load(file.read_text())["hydra"]["sweeper"]["params"]
        told = {"seam_weight": "pair_map", "energy": "param"}.get(file.stem, "overfit")
        for override in overrides_of([], params):
            values = list(override.sweep_string_iterator())
            assert len(set(values)) == len(values) > 1
            words = [f"sweep={file.stem}", f"{override.get_key_element()}={values[-1]}"]
            assert compose_config(words).task.name == told


def test_a_preset_is_a_sweep_without_further_words(tmp_path, here):
    result = here(*TINY, "sweep=domain")
    assert result.returncode == 0, result.stderr
    assert set(jobs(tmp_path)) == {"domain_disc", "domain_square"}


def test_folders_follow_from_the_settings(tmp_path):
    wide = sweep_folder("overfit", ["activation=relu,silu", "seed=3", "surface=cow"])
    assert wide == sweep_folder("overfit", ["surface=cow", "activation=tanh,relu", "seed=3"])
    assert wide != sweep_folder("overfit", ["surface=cow", "activation=tanh,relu", "seed=4"])
    assert sweep_folder("overfit", ["sweep=activation"]) == "outputs/overfit/sweep-activation"
    one = job_folder(tmp_path, {"seed": 1, "map": {"width": 3}}, ["seed=1"])
    one.mkdir()
    assert job_folder(tmp_path, {"map": {"width": 3}, "seed": 1}, ["map.width=3"]) == one
    assert job_folder(tmp_path, {"map": {"width": 4}, "seed": 1}, ["map.width=4"]) != one
