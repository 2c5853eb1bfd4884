"""The help screen and completion: what can be set, with the values of a run."""

import os
import subprocess
import sys

import pytest
import yaml

from nsm.config import composed, conf_folder
from nsm.help import groups, known_keys, option_settings, plain_settings
from nsm.settings import parts

FILES = [file for file in sorted(conf_folder().rglob("*.yaml")) if file.parent != conf_folder()]
OURS = [group.name for group in groups()]


def test_everything_has_a_remark():
    for group in groups():
        assert group.remark, group.name
        assert all(group.options.values()), group.name
    assert all(setting.remark for setting in plain_settings(composed()[0]))


@pytest.mark.parametrize("group", OURS)
def test_every_setting_of_an_option_has_a_remark(group):
    for name in next(one for one in groups() if one.name == group).options:
        for setting in option_settings(group, name):
            # torch leaves some of its parameters without any; a reference takes another's
            known = setting.remark or setting.value.startswith("${")
            assert known or group in ("optimizer", "scheduler"), setting
            if setting.value != "...":
                yaml.safe_load(setting.value)


def test_the_values_are_those_of_the_run():
    for overrides in ([], ["task=param"], ["trainer.max_steps=7"]):
        config, _ = composed(overrides)
        shown = {s.key: s.value for s in plain_settings(config)}
        for part in parts():
            for key, value in config[part].items():
                assert yaml.safe_load(shown[f"{part}.{key}"]) == value


@pytest.mark.parametrize(
    ("arguments", "steps"),
    [
        ([], 100),
        (["task=param"], 8),
        (["initialization=random"], 8000),
        (["trainer.max_steps=7"], 7),
    ],
)
def test_help_on_a_setting_shows_its_value(here, arguments, steps):
    for name in ("trainer", "trainer.max_steps"):
        first = [
            line.split()[0]
            for line in here("--help", name, *arguments).stdout.splitlines()
            if "trainer.max_steps=" in line
        ]
        assert first[0] == f"trainer.max_steps={steps}"


def test_help_on_a_setting_shows_who_sets_it(here):
    assert "experiment=fast" in here("--help", "trainer.max_steps").stdout


def test_help_shows_the_value_of_the_chosen_option(here):
    result = here("--help", "activation.beta", "activation.beta=3.5")
    assert "* activation=softplus\n" in result.stdout
    assert "activation.beta=3.5" in result.stdout and "activation.beta=1.0" in result.stdout


def test_help_names_every_option(here):
    result = here("--help")
    assert result.returncode == 0
    for file in FILES:
        assert file.stem in result.stdout
    assert "  * softplus " in result.stdout


def test_help_on_a_group_shows_its_settings(here):
    result = here("--help", "encoding")
    assert "encoding.resolutions=[8, 32, 128]" in result.stdout
    assert "encoding.sigma" in result.stdout and "trainer" not in result.stdout
    assert "optimizer.weight_decay" in here("--help", "optimizer").stdout


@pytest.mark.parametrize("name", ["landmarks", "source=a.obj", "certification", "seam.path"])
def test_help_on_plain_settings(here, name):
    result = here("--help", name)
    assert (result.returncode, result.stderr) == (0, "")
    assert name.split("=")[0] in result.stdout and "seed=" not in result.stdout


def test_help_near_a_setting(here):
    for name, near in (("encodin", "encoding"), ("trainer.max_step", "trainer.max_steps")):
        result = here("--help", name)
        assert (result.returncode, len(result.stderr.splitlines())) == (2, 1)
        assert near in result.stderr


@pytest.mark.parametrize("name", ["loss_weights", "data", "logger", "hydra/sweeper", "trainer"])
def test_help_folds_no_setting(here, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "80")
    lines = here("--help", name).stdout.splitlines()
    found = [group for group in groups() if group.name == name]
    run, choices = composed()
    for group in found:
        for option in group.options:
            for s in option_settings(name, option, run if choices.get(name) == option else None):
                assert any(f" {s.key}={s.value} " in f"{line} " for line in lines), s
    if not found:
        for s in plain_settings(composed()[0]):
            if s.key.startswith(f"{name}."):
                assert any(f" {s.key}={s.value} " in f"{line} " for line in lines), s


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("nsm activation=s", "activation=softplus"),
        ("nsm doma", "domain="),
        ("nsm trainer.max_", "trainer.max_steps="),
        ("nsm optimizer=rmsprop optimizer.mo", "optimizer.momentum="),
    ],
)
def test_shells_complete(here, monkeypatch, line, expected):
    monkeypatch.setenv("COMP_LINE", line)
    assert expected in here("-sc", "query=bash").stdout.split()


def test_the_overview_does_not_wait_for_torch():
    code = "import sys; sys.argv = ['nsm', '--help']; from nsm.cli import main; main(); "
    code += "assert 'torch' not in sys.modules"
    environment = {**os.environ, "COLUMNS": "100"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True)
    assert result.returncode == 0, result.stderr


def test_known_keys_are_those_of_the_help():
    shown = {s.key for s in plain_settings(composed()[0])}
    assert shown <= set(known_keys())


def test_help_shows_options_of_an_own_folder(here, tmp_path):
    (tmp_path / "conf" / "energy").mkdir(parents=True)
    file = tmp_path / "conf" / "energy" / "mine.yaml"
    file.write_text("_target_: nsm.energies.SymmetricDirichlet\nepsilon: 0.25\n")
    result = here("--help", "energy", "--config-dir=conf", "task=param", "energy=mine")
    assert result.returncode == 0, result.stderr
    assert "* energy=mine" in result.stdout and "energy.epsilon=0.25" in result.stdout
