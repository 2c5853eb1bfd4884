"""The command: its first word, flags, and the answers to mistakes."""

import json
import shlex
import shutil
import subprocess
import sys
import types
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml
from tiny import TRAINING

import nsm
from nsm import cli, stages
from nsm.arguments import Arguments

OLDER = Path(__file__).parent / "data_v1"
SQUARE = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
DEFECTS = """
import pytorch_lightning as pl

class Broken:
    def __init__(self, how="value"):
        if how == "value":
            raise ValueError("bad how")
        if how == "defect":
            raise ZeroDivisionError("a defect")

    def __call__(self, source, target):
        return (target - source).square().sum(dim=(-2, -1))

class Callback(pl.Callback):
    def on_train_start(self, trainer, module):
        raise KeyError("missing")
"""


@pytest.fixture
def echo(monkeypatch):
    """A command ``echo FOLDER`` in the table; what it was called with."""
    seen: list[str] = []

    def main(arguments: list[str]) -> None:
        parser = Arguments(prog="nsm echo")
        parser.add_argument("folder")
        seen.append(parser.parse_args(arguments).folder)

    module = types.ModuleType("echo_command")
    module.main = main
    monkeypatch.setitem(sys.modules, "echo_command", module)
    monkeypatch.setitem(cli.COMMANDS, "echo", "echo_command")
    return seen


@pytest.fixture
def defects(tmp_path):
    """The user's module ``defects_for_test`` in the current folder."""
    (tmp_path / "defects_for_test.py").write_text(DEFECTS)
    (tmp_path / "patch.off").write_text(SQUARE)
    yield
    sys.modules.pop("defects_for_test", None)


def test_a_command_gets_the_arguments_after_its_name(echo, here):
    result = here("echo", "runs")
    assert (result.returncode, echo) == (0, ["runs"])


def test_a_mistaken_command_line_is_one_line_and_status_2(echo, here):
    result = here("echo", "runs", "--loud")
    assert (result.returncode, len(result.stderr.splitlines()), echo) == (2, 1, [])
    assert "--loud" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["eco"], "eco"),
        (["--foo"], "--foo"),
        (["-m", "--foo", "seed=1,2"], "--foo"),
        (["--cfg", "jobs"], "--cfg"),
        (["--resolve"], "--resolve"),
        (["--experimental-rerun", "gone.pickle"], "--experimental-rerun"),
        (["-m", "--cfg", "job"], "--cfg"),
        (["lambda.foo=2"], "loss_weights.foo"),
        (["surface=/nowhere/mesh.obj"], "/nowhere/mesh.obj"),
        (["nowhere.obj"], "nowhere.obj"),
        (["logger=3"], ""),  # Hydra does not say which group
        (["resume=nowhere", "seed=1"], "seed=1"),
    ],
)
def test_a_mistake_is_one_line(here, arguments, named, monkeypatch):
    # on a busy machine, the import of torch takes so long that progress is printed
    monkeypatch.setattr(stages, "QUIET_FOR", 600.0)
    result = here(*arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert named in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_ctrl_c_is_answered_whenever_it_comes(here, tmp_path, monkeypatch):
    (tmp_path / "patch.off").write_text(SQUARE)

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("nsm.pipeline.overfit.OverfitTask.prepare", stop)
    result = here(*TRAINING)
    assert (result.returncode, result.stderr) == (130, "nsm: interrupted\n")


def test_ctrl_c_while_files_are_written_says_how_to_go_on(here, tmp_path, monkeypatch):
    (tmp_path / "patch.off").write_text(SQUARE)

    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("nsm.pipeline.overfit.OverfitTask.write_artefacts", stop)
        result = here(*TRAINING, "artefacts=true", "hydra.run.dir=a run (1)")
    assert (result.returncode, result.stderr) == (130, "")
    _, _, command = result.stdout.strip().splitlines()[-1].partition("nsm ")
    (word,) = shlex.split(command)
    result = here(word)
    assert result.returncode == 0 and (tmp_path / "a run (1)" / "metrics.json").exists()


def test_the_settings_shown_are_those_of_the_run(here, tmp_path):
    """What a run stores, with the defaults of what the options name; nothing is run."""
    (tmp_path / "patch.off").write_text(SQUARE)
    shown = yaml.safe_load(here("--cfg", "job", *TRAINING, "logger=none").stdout)
    assert not (tmp_path / "outputs").exists()
    result = here(*TRAINING, "logger=none", "hydra.run.dir=run")
    assert result.returncode == 0, result.stderr
    stored = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    for one in (shown, stored):
        one.pop("domain"), one["surface"].pop("path")  # made definite by the mesh
    assert shown == stored


def test_flags_may_stand_anywhere(here):
    result = here("seed=1", "--cfg", "job", "trainer.max_steps=3")
    assert result.returncode == 0 and "max_steps: 3" in result.stdout


def test_the_flags_of_hydra_are_known(here):
    listed = here("--hydra-help").stdout
    for names in cli._HYDRA_FLAGS:
        assert names[0] in listed


def test_the_version_is_ours(here):
    assert here("--version").stdout == f"nsm {version('nsm')}\n"


def test_a_mesh_file_is_enough(here, tmp_path):
    (tmp_path / "my mesh (1).off").write_text(SQUARE)
    training = [setting for setting in TRAINING if not setting.startswith("surface.path")]
    result = here("my mesh (1).off", *training, "hydra.run.dir=run", "logger=none")
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 4


@pytest.mark.parametrize(
    ("settings", "status", "named"),
    [
        (["energy.how=value"], 2, "ValueError"),
        (["energy.how=defect"], 1, "ZeroDivisionError"),
        (["energy=arap", "callbacks.mine._target_=defects_for_test.Callback"], 1, "KeyError"),
    ],
)
def test_defects_of_the_users_code(here, defects, settings, status, named):
    settings = ["task=param", "energy._target_=defects_for_test.Broken", *settings]
    if "energy=arap" in settings:
        settings = ["task=overfit", *TRAINING, "logger=none", settings[-1]]
    short = here(*settings)
    assert (short.returncode, len(short.stderr.splitlines())) == (status, 1)
    assert "defects_for_test.py:" in short.stderr and "--debug" in short.stderr
    full = here("--debug", *settings)
    assert full.returncode == status
    assert f"{named}: " in full.stderr and "Traceback" in full.stderr
    assert full.stderr.splitlines()[-1] == short.stderr.strip()


def test_classes_of_the_current_folder_and_other_libraries(here, defects, tmp_path):
    result = here(
        *TRAINING,
        "hydra.run.dir=run",
        "optimizer._target_=torch.optim.NAdam",
        "activation._target_=torch.nn.Mish",
        "+callbacks.mine._target_=pytorch_lightning.callbacks.Timer",
        "logger=csv",
    )
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "run" / "csv" / "metrics.csv").is_file()


def test_a_run_of_an_older_version_is_resumed(here, tmp_path):
    shutil.copytree(OLDER / "interrupted", tmp_path, dirs_exist_ok=True)
    result = here(f"resume={tmp_path}")
    assert result.returncode == 0, result.stderr
    stored = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert stored["activation"]["_target_"].startswith("nsm.maps.activations.")
    figures = json.loads((tmp_path / "metrics.json").read_text())
    assert figures["steps"] == stored["trainer"]["max_steps"]


def test_a_refused_class_is_named_with_its_file(here, tmp_path):
    shutil.copytree(OLDER / "interrupted", tmp_path, dirs_exist_ok=True)
    file = tmp_path / "config.yaml"
    file.write_text(file.read_text() + "\ncallbacks: {mine: {_target_: os.system}}\n")
    result = here(f"resume={tmp_path}")
    assert result.returncode == 2
    assert str(file) in result.stderr and "os.system" in result.stderr


# other libraries are imported once, and nsm in a process for each package
IN_ANY_ORDER = """
import os, random, hydra, pytorch_lightning
for package in ("data", "domains", "energies", "maps", "results", "tasks"):
    if os.fork() == 0:
        failed = True
        try:
            import nsm
            state = random.getstate()
            getattr(nsm, package), nsm.overfit
            failed = state != random.getstate()
        finally:
            os._exit(failed)
    assert os.wait()[1] == 0, package
"""


def test_packages_are_there_in_any_order():
    subprocess.run([sys.executable, "-W", "ignore", "-c", IN_ANY_ORDER], check=True)


def test_public_names_are_listed():
    assert set(nsm.__all__) <= set(dir(nsm))
    assert all(getattr(nsm, name) is not None for name in nsm.__all__)
