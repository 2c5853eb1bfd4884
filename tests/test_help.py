"""The help screen and completion: all that conf/ offers, said to people and shells."""

import os
import subprocess
import sys

import pytest
import yaml

from nsm.config import compose_config, conf_folder
from nsm.config_docs import groups, ungrouped

FILES = [file for file in sorted(conf_folder().rglob("*.yaml")) if file.parent != conf_folder()]


def test_every_group_option_and_setting_has_a_remark():
    for group in groups():
        assert group.remark, group.name
        for option in group.options:
            assert option.remark, (group.name, option.name)
            for setting in option.settings:
                assert setting.remark, setting
    assert all(setting.remark for setting in ungrouped())


def test_it_reads_what_yaml_reads():
    """Beside a whole YAML parser: no key is lost, and values are those of the composition."""

    def leaves(node, prefix=""):
        for key, value in node.items():
            if isinstance(value, dict):
                yield from leaves(value, f"{prefix}{key}.")
            else:
                yield f"{prefix}{key}"

    expected = leaves(yaml.safe_load((conf_folder() / "config.yaml").read_text()))
    own = {key for key in expected if not key.startswith(("hydra", "defaults"))}
    assert {setting.key for setting in ungrouped()} == own
    trainer = next(group for group in groups() if group.name == "trainer").options[0]
    config = compose_config().trainer
    assert {s.key for s in trainer.settings} == {f"trainer.{key}" for key in config}
    config = compose_config(["initialization=random"]).trainer
    for setting in trainer.settings:
        assert yaml.safe_load(setting.value) == config[setting.key.split(".")[1]]


def test_help_names_every_option(here):
    result = here("--help")
    assert result.returncode == 0
    for file in FILES:
        assert file.stem in result.stdout
    assert "  * softplus " in result.stdout
    assert "The published softplus, β = 1." in result.stdout


def test_help_on_a_group_tells_its_settings(here):
    result = here("--help", "encoding")
    assert "encoding.resolutions=[8, 32, 128]" in result.stdout
    assert "cells a side" in result.stdout
    assert "trainer" not in result.stdout
    assert "'encoding'" in here("--help", "encodin").stderr


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("landmarks", "landmarks=null"),
        ("source=a.obj", "source=null"),
        ("certification", "certification.rounds=2"),
        ("trainer.max_steps", "experiment=paper"),
    ],
)
def test_help_on_a_setting_tells_where_it_stands(here, name, expected):
    result = here("--help", name)
    assert (result.returncode, result.stderr) == (0, "")
    assert expected in result.stdout
    assert "seed=" not in result.stdout


def test_help_near_a_setting(here):
    assert "'energy.lambda_normal'" in here("--help", "lambda_normal").stderr


def test_help_folds_no_setting(here, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for group in groups():
        lines = here("--help", group.name).stdout.splitlines()
        for setting in (s for option in group.options for s in option.settings):
            assert any(f" {setting.key}={setting.value} " in f"{line} " for line in lines)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("nsm activation=s", "activation=softplus"),
        ("nsm doma", "domain="),
        ("nsm trainer.max_", "trainer.max_steps="),
        ("nsm optimizer=rmsprop optimizer.mo", "optimizer.momentum="),
    ],
)
def test_shells_are_told_what_may_follow(here, monkeypatch, line, expected):
    monkeypatch.setenv("COMP_LINE", line)
    assert expected in here("-sc", "query=bash").stdout.split()


def test_help_does_not_wait_for_torch():
    code = "import sys; sys.argv = ['nsm', '--help']; from nsm.cli import main; main(); "
    code += "assert 'torch' not in sys.modules"
    environment = {**os.environ, "COLUMNS": "100"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True)
    assert result.returncode == 0, result.stderr
