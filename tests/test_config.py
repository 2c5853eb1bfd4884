"""The configuration: every option composes and can be made, and mistakes are named."""

import random
import sys
import types
from importlib import import_module

import hydra
import numpy as np
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from nsm.config import compose_config, composed, conf_folder, read_config
from nsm.config_validation import checked
from nsm.domains import Surface
from nsm.errors import NotTrusted, NsmError
from nsm.help import known_keys
from nsm.instantiation import check_trusted, made
from nsm.migration import OPTIONS, RENAMED
from nsm.settings import Settings, parameters
from nsm.surfaces import catalogue_names

FILES = sorted(
    (file.parent.relative_to(conf_folder()).as_posix(), file.stem)
    for file in conf_folder().rglob("*.yaml")
    if file.parent != conf_folder()
)
# the task that an option is for, if it is not for all
TASKS = {
    ("loss_weights", "adam_param"): "param",
    ("loss_weights", "adam_pair_map"): "pair_map",
    ("loss_weights", "adam_collection_map"): "collection_map",
    ("constraints", "adam_param"): "param",
    ("constraints", "adam_pair_map"): "pair_map",
    ("constraints", "adam_collection_map"): "collection_map",
    ("constraints", "fast_pair_map"): "pair_map",
    ("loss_weights", "fast_pair_map"): "pair_map",
    ("data", "levels_pair_map"): "pair_map",
    ("constraints", "fast_param"): "param",
    ("loss_weights", "fast_param"): "param",
    ("data", "levels_param"): "param",
    ("constraints", "fast_collection_map"): "collection_map",
    ("loss_weights", "fast_collection_map"): "collection_map",
    ("data", "levels_collection_map"): "collection_map",
    ("experiment", "fast"): "pair_map",
    ("experiment", "preview"): "pair_map",
    ("published", "param"): "param",
    ("published", "pair_map"): "pair_map",
    ("constraints", "pair_newton"): "pair_map",
    ("constraints", "collection_newton"): "collection_map",
    ("loss_weights", "collection_newton"): "collection_map",
    ("loss_weights", "pair_newton"): "pair_map",
    ("optimizer", "adam_newton"): "pair_map",
    ("optimizer", "collection_newton"): "collection_map",
    ("experiment", "adam"): "pair_map",
    ("published", "collection_map"): "collection_map",
    ("data", "collection"): "collection_map",
}


@pytest.fixture
def mine(monkeypatch):
    """A module of the user's, ``mine_for_test``."""
    module = types.ModuleType("mine_for_test")

    class Energy:
        """An energy.

        Args:
            power: what the stretch is raised to.
        """

        def __init__(self, power: float = 1.0, *, sign: int = 1) -> None:
            if power == 13:
                raise RuntimeError("a defect")
            self.power = power

        def __call__(self, source, target):
            return torch.linalg.det(target) ** self.power

    class Term:
        def __init__(self, margin: float = 0.5) -> None:
            self.margin = margin

    for kind in (Energy, Term):
        kind.__module__, kind.__qualname__ = module.__name__, kind.__name__
        setattr(module, kind.__name__, kind)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module


@pytest.mark.parametrize(("group", "name"), FILES)
def test_every_option_composes_and_is_made(group, name):
    task = TASKS.get((group, name), "param" if group == "energy" else "overfit")
    overrides = [f"{group}={name}"] if group == "task" else [f"task={task}", f"{group}={name}"]
    if group == "published":  # which experiment=paper chooses
        overrides = [f"task={task}", "experiment=paper"]
    if group == "constraints" and name.startswith("fast_"):  # weights are chosen beside them
        overrides.append(f"loss_weights={name}")
    config = compose_config(overrides)  # which makes network, optimizer, scheduler and more
    if group in ("energy", "domain", "sampler"):
        assert made(config[group]) is not None
    if group.startswith("hydra/"):
        made(OmegaConf.load(conf_folder() / group / f"{name}.yaml"))


def test_an_option_repeats_no_default():
    for group, name in FILES:
        node = yaml.safe_load((conf_folder() / group / f"{name}.yaml").read_text()) or {}
        if node.get("_target_", "").startswith("nsm."):  # torch's may change
            module, _, kind = node["_target_"].rpartition(".")
            known = parameters(getattr(import_module(module), kind))[0]
            for key in set(node) & set(known):
                default = known[key].default
                assert node[key] != (list(default) if isinstance(default, tuple) else default)


def test_what_is_completed_is_not_changed_again():
    for task in ("overfit", "param", "pair_map", "collection_map"):
        config = compose_config([f"task={task}"])
        assert checked(config) == config


def test_the_check_leaves_the_random_numbers():
    torch.manual_seed(1)
    np.random.seed(1)
    random.seed(1)
    expected = torch.rand(3), np.random.rand(), random.random()
    torch.manual_seed(1)
    np.random.seed(1)
    random.seed(1)
    compose_config(["map=residual"])
    assert torch.equal(torch.rand(3), expected[0])
    assert (np.random.rand(), random.random()) == expected[1:]


def test_the_callers_hydra_is_left(tmp_path):
    (tmp_path / "theirs.yaml").write_text("a: 1\n")
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        theirs = GlobalHydra.instance().hydra
        compose_config(["activation=silu"])
        with pytest.raises(NsmError):
            compose_config(["activation=sillu"])
        assert GlobalHydra.instance().hydra is theirs
        assert compose("theirs").a == 1
    compose_config([])
    assert not GlobalHydra.instance().is_initialized()


def test_it_composes_within_the_callers_hydra_main(tmp_path, monkeypatch):
    (tmp_path / "theirs.yaml").write_text("a: 1\nhydra: {run: {dir: .}, output_subdir: null}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["theirs", "a=2"])
    seen = []

    @hydra.main(config_path=str(tmp_path), config_name="theirs", version_base="1.3")
    def main(config):
        seen.append((compose_config(["seed=3"]).seed, config.a))
        seen.append(hydra.core.hydra_config.HydraConfig.get().overrides.task[0])

    main()
    assert seen == [(3, 2), "a=2"]


def test_groups_can_be_changed_separately():
    config = compose_config(
        ["task=pair_map", "data=levels_pair_map", "sampler=pool", "domain=square"]
    )
    assert (config.data.points[0], config.sampler.pool) == (2048, 500_000)
    assert config.domain._target_ == "nsm.domains.Square"
    own = ["constraints=fast_pair_map", "loss_weights=adam_pair_map"]
    config = compose_config(["task=pair_map", *own])
    assert (config.constraints.multiplier_every, config.loss_weights.seam) == (1, 1e3)
    config = compose_config(["task=pair_map", "experiment=paper", *own])
    assert (config.constraints.multiplier_every, config.map.width) == (1, 128)


@pytest.mark.parametrize(
    ("overrides", "linear_skip", "steps"),
    [
        ([], "fitted", 100),
        (["map=residual"], "fitted", 100),
        (["initialization=random"], "none", 8000),
        (["encoding=fourier"], "none", 8000),
        (["encoding=identity"], "none", 8000),
        (["encoding=fourier", "initialization=fitted"], "fitted", 100),
        (["experiment=fit"], "fitted", 0),
        (["experiment=paper"], "none", 50_000),
        (["sweep=activation"], "none", 8000),
        (["task=param", "experiment=adam"], "none", 1500),
        (["task=pair_map", "experiment=adam", "encoding=fourier"], "none", 1500),
    ],
)
def test_only_a_grid_and_a_surface_can_be_fitted(overrides, linear_skip, steps):
    config = compose_config(overrides)
    assert (config.map.linear_skip, config.trainer.max_steps) == (linear_skip, steps)
    assert config.scheduler.get("peak", 1.0) == (0.0001 if linear_skip == "fitted" else 1.0)


def test_the_surface_group_is_the_catalogue():
    files = {name for group, name in FILES if group == "surface"}
    assert files == set(catalogue_names())
    for name in files:
        assert composed([f"surface={name}"])[0].surface.name == name


@pytest.mark.parametrize("task", ["param", "pair_map", "collection_map"])
def test_a_sweep_of_energies_is_for_every_map(task):
    assert compose_config(["sweep=energy", f"task={task}"]).task.name == task


@pytest.mark.parametrize("sweep", ["activation", "architecture"])
@pytest.mark.parametrize(
    "task",
    [
        "task=overfit",
        "task=param experiment=adam",
        "task=collection_map experiment=adam",
        "task=pair_map experiment=adam",
    ],
)
def test_sweeps_of_networks_train_networks_without_a_grid(sweep, task):
    config = compose_config([f"sweep={sweep}", *task.split()])
    assert config.encoding._target_ == "nsm.maps.encodings.Identity"
    assert config.map._target_ == "nsm.maps.NeuralMap"  # on closed domains, too
    assert config.optimizer._target_ == "torch.optim.Adam"


@pytest.mark.parametrize(
    ("overrides", "kind", "key"),
    [
        ("trainer.max_step=10", "unknown_setting", "trainer.max_step"),
        ("+trainer.max_step=10", "unknown_setting", "trainer.max_step"),
        ("activaton=silu", "unknown_setting", "activaton"),
        ("activation=sillu", "unknown_option", "activation"),
        ("surface=bunnny", "unknown_option", "surface"),
        ("domain=squre", "unknown_option", "domain"),
        ("task=overfit experiment=fast", "unknown_option", "experiment"),
        # a spline has none of them
        ("task=pair_map activation=relu", "conflicting_settings", "activation"),
        ("task=pair_map encoding.degree=3", "conflicting_settings", "encoding.degree"),
        ("task=param experiment=fast encoding=fourier", "conflicting_settings", "encoding"),
        ("task=pair_map sweep=architecture", None, "optimizer"),
        ("trainer.max_steps=many", "wrong_type", "trainer.max_steps"),
        ("trainer.accelerator=gppu", "unknown_option", "trainer.accelerator"),
        ("trainer.precision=half", "unknown_option", "trainer.precision"),
        ("data.batch_size=0", "out_of_range", "data.batch_size"),
        ("sampler.vertex_share=2", "out_of_range", None),
        ("sampler.domain_share=0.95", "out_of_range", "sampler.domain_share"),
        ("trainer.max_steps=[", "unreadable_setting", "trainer.max_steps=["),
        ("eco", "unreadable_setting", "eco"),
        ("seed=1,2", "several_values", "seed"),
        ("+seed=1", "already_set", "seed"),
        ("surface.parameterization=slimm", "unknown_option", "surface.parameterization"),
        ("phi.overrides=['map.widht=3']", "unknown_setting", "map.widht"),
        ("activation.bta=3", "unknown_setting", "activation.bta"),
        ("+activation.bta=3", "unknown_setting", "activation.bta"),
        ("activation=relu activation.beta=3", "unknown_setting", "activation.beta"),
        ("activation.beta=soft", "wrong_type", "activation.beta"),
        ("encoding.feature=4", "unknown_setting", "encoding.feature"),
        ("encoding.features=2.5", "wrong_type", "encoding.features"),
        ("encoding.resolutions=[]", None, "encoding"),
        ("encoding.resolutions=[8,0]", None, "encoding"),
        ("encoding.resolutions=[16,many]", "wrong_type", "encoding.resolutions"),
        ("encoding.extent=0", None, "encoding"),
        ("encoding.extent=nan", "out_of_range", "encoding.extent"),
        ("encoding.degree=7", None, "encoding"),
        ("activation=sine activation.omega=0 map.initialization=siren", None, None),
        ("logger=3", "wrong_type", None),
        ("seed=-1", "out_of_range", "seed"),
        ("seed=4294967296", "out_of_range", "seed"),
        ("data.steps_per_epoch=9223372036854775808", "out_of_range", "data.steps_per_epoch"),
        ("optimizer.encoding_lr=-1", "out_of_range", "optimizer"),
        ("optimizer=rmsprop optimizer.momentun=0.1", "unknown_setting", "optimizer.momentun"),
        ("optimizer.momentum=0.1", "unknown_setting", "optimizer.momentum"),
        ("optimizer.lr=fast", "wrong_type", "optimizer.lr"),
        ("optimizer.betas=[2,3]", "not_instantiable", "optimizer"),
        ("optimizer._target_=torch.optim.Nadam", "not_importable", "optimizer._target_"),
        ("optimizer._target_=torch.pi", "wrong_type", "optimizer._target_"),
        ("scheduler=sgdr scheduler.periode=9", "unknown_setting", "scheduler.periode"),
        ("scheduler=sgdr scheduler.period=0", "out_of_range", "scheduler.period"),
        ("scheduler=sgdr scheduler.period_factor=0.5", "out_of_range", "scheduler.period_factor"),
        ("scheduler.warmup=-1", "out_of_range", "scheduler.warmup"),
        ("loss_weights.normall=1", "unknown_setting", "loss_weights.normall"),
        ("loss_weights=adam_pair_map", "unknown_setting", "loss_weights.injectivity"),
        ("constraints=adam_pair_map", "unknown_setting", "constraints"),
        ("task=param constraints.bondary=fixed", "unknown_setting", "constraints.bondary"),
        ("task=param constraints.boundary=fixd", "unknown_option", "constraints.boundary"),
        ("task=pair_map constraints.ramp=3", "out_of_range", "constraints.ramp"),
        ("task=pair_map constraints.multiplier_every=often", "wrong_type", None),
        ("task=pair_map loss_weights=adam_param", "missing_setting", "loss_weights.boundary"),
        ("task=param energy=null", None, None),
        ("callbacks.mine.patience=3", "missing_setting", "callbacks.mine"),
        (
            "loss_terms.mine._target_=mine_for_test.Term",
            "missing_setting",
            "loss_terms.mine.weight",
        ),
        ("task=param energy._target_=mine_for_test.Energy energy.pwer=3", "unknown_setting", None),
        ("task=param energy._target_=mine_for_test.Energy energy.power=x", "wrong_type", None),
        ("task=param energy._target_=mine_for_test.Enrgy", "not_importable", "energy._target_"),
    ],
)
def test_a_mistake_is_one_line_with_kind_and_key(overrides, kind, key, mine):
    with pytest.raises(NsmError) as error:
        compose_config(overrides.split())
    assert len(str(error.value).splitlines()) == 1
    assert kind is None or error.value.kind == kind
    assert key is None or error.value.key.startswith(key)


def test_a_mistake_names_the_nearest():
    for override, near in (
        ("trainer.max_step=10", "max_steps"),
        ("activaton=silu", "activation"),
        ("activation=sillu", "silu"),
        ("optimizer._target_=torch.optim.Nadam", "torch.optim.NAdam"),
        ("trainer.acelerator=gpu", "accelerator"),
        ("landmarks.strict=true", "proposal.strict"),
    ):
        with pytest.raises(NsmError) as error:
            compose_config([override])
        assert near in str(error.value)


@pytest.mark.parametrize(
    ("overrides", "key", "expected"),
    [
        ("optimizer._target_=torch.optim.NAdam", "optimizer.betas", [0.9, 0.99]),
        ("optimizer._target_=torch.optim.SGD", "optimizer.betas", None),
        ("optimizer.weight_decay=1", "optimizer.weight_decay", 1.0),
        ("+optimizer.weight_decay=1", "optimizer.weight_decay", 1.0),
        ("activation._target_=torch.nn.Mish", "activation.beta", None),
        ("activation._target_=torch.nn.Tanh", "activation.beta", None),
        ("activation._target_=torch.nn.CELU activation.alpha=2", "activation.alpha", 2.0),
        (
            "scheduler._target_=torch.optim.lr_scheduler.StepLR scheduler.step_size=5",
            "scheduler.step_size",
            5,
        ),
        ("task=param energy._target_=mine_for_test.Energy", "energy.power", None),
        ("task=param energy._target_=mine_for_test.Energy energy.power=2", "energy.power", 2.0),
        (
            "+callbacks.mine._target_=pytorch_lightning.callbacks.EarlyStopping "
            "+callbacks.mine.monitor=val/rms",
            "callbacks.mine.monitor",
            "val/rms",
        ),
        (
            "+loss_terms.mine._target_=mine_for_test.Term +loss_terms.mine.weight=1",
            "loss_terms.mine.weight",
            1.0,
        ),
        (
            "logger.mine._target_=pytorch_lightning.loggers.CSVLogger logger.mine.save_dir=x",
            "logger.mine.save_dir",
            "x",
        ),
        ("task=pair_map constraints.multiplier_every=7", "constraints.multiplier_every", 7),
        ("trainer.gradient_clip=1", "trainer.gradient_clip", 1.0),
    ],
)
def test_any_class_works_from_the_command_line(overrides, key, expected, mine):
    assert OmegaConf.select(compose_config(overrides.split()), key) == expected


def test_a_defect_of_the_users_code_passes(mine):
    with pytest.raises(RuntimeError):
        compose_config(["task=param", "energy._target_=mine_for_test.Energy", "energy.power=13"])


@pytest.mark.parametrize(
    "name", ["a b.obj", "a=b.obj", "it's.obj", 'a "b".obj', "a(1),b.obj", "a\\b.obj", "ü{1}.obj"]
)
def test_paths_with_special_signs(name):
    for override in (name, f"surface={name}", f"surface.path={name}", f"surface=/x/{name}"):
        if "," in name and override == f"surface={name}":
            continue  # two files, for a sweep
        if "=" in name and override == name:
            continue  # a setting
        path = composed([override])[0].surface.path
        assert path == (f"/x/{name}" if "/x/" in override else name)
    assert composed(["surface=cow"])[0].surface.path is None


@pytest.mark.parametrize(
    "old", [*RENAMED, *OPTIONS, ("optimizer.name", "adam"), ("trainer", "default")]
)
def test_an_old_name_is_answered_with_the_new_one(old):
    key, value = old if isinstance(old, tuple) else (old, "1")
    with pytest.raises(NsmError) as error:
        compose_config([f"{key}={value}"])
    assert (error.value.kind, error.value.key) == ("renamed_setting", key)
    if not isinstance(old, tuple):
        with pytest.raises(NsmError) as error:
            compose_config([f"+{old}.foo=2"])
        assert f"{RENAMED[old]}.foo=2" in str(error.value)


def test_weights_of_an_energy_are_answered_with_blend():
    with pytest.raises(NsmError) as error:
        compose_config(["task=param", "energy=arap", "energy.weights.arap=1"])
    assert (error.value.kind, error.value.key) == ("renamed_setting", "energy.weights")
    blend = ["task=param", "energy._target_=nsm.energies.Blend", "energy.weights.arap=1"]
    assert compose_config(blend).energy.weights == {"arap": 1}


def test_an_experiment_suits_other_options_than_the_default():
    config = compose_config(["experiment=quick", "encoding=fourier"])
    assert "resolutions" not in config.encoding
    with pytest.raises(NsmError) as error:
        compose_config(["encoding=fourier", "encoding.resolutions=[8]"])
    assert error.value.key == "encoding.resolutions"


def test_new_names_exist():
    known = set(known_keys())
    for new in RENAMED.values():
        group = new.partition(".")[0]
        assert new in known or group in known
    for group, name in OPTIONS.values():
        assert (group, name) in FILES


V1 = """
task: {name: TASK}
phi: {path: null, overrides: []}
surface: {path: null, name: cow, seam_vertices: null, parameterization: slim, cache: true}
source: null
target: null
surfaces: null
landmarks: null
attributes: {source: null, target: null}
seam: {path: auto, landmarks: null}
guarantee: {repair: true, rounds: 3}
map: {width: 64, depth: 1, block: plain, initialisation: kaiming, readout: none}
activation: {name: softplus, beta: 10.0}
encoding: {name: spline_grid, resolutions: [8, 32], features: 4, degree: 2, extent: 1.05}
energy: ENERGY
constraints: CONSTRAINTS
data: {batch_size: 64, steps_per_epoch: 5, vertex_share: 0.25, domain_share: 0.0, pool: null,
       held_out: 128}
optimizer: {name: adam, lr: 0.003, encoding_lr: 0.03, betas: [0.9, 0.99], eps: 1.0e-12}
scheduler: {name: cosine, warmup: 100, final: 0.0, peak: 0.003}
trainer: {max_steps: 1000, accelerator: auto, devices: 1, stop_gradient_norm: null,
          stop_window: 100, threads: 1, gradient_clip: null, progress: true, precision: float32,
          compile: false}
logger: {kinds: [tensorboard, csv], every: 10, pictures: 3, project: nsm, uri: null}
domain: square
seed: 7
artefacts: true
resume: null
"""
LAMBDAS = ("injectivity", "boundary", "landmarks", "seam", "triangles")


@pytest.mark.parametrize("task", ["overfit", "param", "pair_map", "collection_map"])
def test_the_configuration_of_an_older_run_is_read(task, tmp_path):
    names = {"overfit": (), "param": (LAMBDAS[0], LAMBDAS[-1])}.get(task, LAMBDAS)
    held = {f"lambda_{name}": 2.0 for name in names}
    if task == "param":
        held["boundary"] = "free"
    elif task != "overfit":
        held.update(boundary="exact", landmarks="augmented", multiplier_every=50, ramp=0.5)
    energy = {"lambda_normal": 0.5} if task == "overfit" else {"weights": {"arap": 2.0}}
    text = V1.replace("TASK", task).replace("ENERGY", str(energy))
    (tmp_path / "config.yaml").write_text(text.replace("CONSTRAINTS", str(held or "null")))
    config = checked(read_config(tmp_path / "config.yaml"))
    check_trusted(OmegaConf.to_container(config))
    assert (config.task.name, config.seed, config.surface.name) == (task, 7, "cow")
    assert config.domain._target_ == "nsm.domains.Square"
    assert dict(config.activation) == {"_target_": "nsm.maps.activations.Softplus", "beta": 10.0}
    assert (config.map.linear_skip, config.map.initialization) == ("none", "kaiming")
    assert (config.sampler.vertex_share, config.data.batch_size) == (0.25, 64)
    assert config.certification.rounds == 3
    assert (config.trainer.log_every, config.trainer.log_pictures) == (10, 3)
    assert set(config.logger) == {"tensorboard", "csv"}
    expected = dict.fromkeys(names, 2.0) if names else {"normal": 0.5}
    assert dict(config.loss_weights) == expected
    if task != "overfit":
        assert made(config.energy) is not None


@pytest.mark.parametrize(
    "text",
    [
        "a",
        "[1, 2]",
        "task: {name: overfit}",
        "task: &a {name: overfit}",
        "task: !!python/object:os.system {}",
        "seed: ${oc.env:HOME}",
        "task: {_target_: a",
        V1.replace("{name: softplus, beta: 10.0}", "3").replace("TASK", "overfit"),
    ],
)
def test_a_file_that_is_no_configuration_is_refused(text, tmp_path):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(NsmError) as error:
        read_config(tmp_path / "config.yaml")
    assert (error.value.kind, error.value.key) == ("damaged_file", str(tmp_path / "config.yaml"))


def test_a_stored_target_of_others_is_refused(tmp_path, mine):
    file = tmp_path / "config.yaml"
    config = compose_config(["activation._target_=torch.nn.Mish"])
    check_trusted(OmegaConf.to_container(config))
    for target in (
        "os.system",
        "subprocess.Popen",
        "nsm.cli.main",
        "torch.hub.load",
        "mine_for_test.Term",
    ):
        config.activation = {"_target_": target}
        file.write_text(OmegaConf.to_yaml(config))
        stored = OmegaConf.to_container(read_config(file))
        with pytest.raises(NotTrusted) as error:
            check_trusted(stored)
        assert error.value.key == target.split(".")[0]
    check_trusted(stored, trust=["mine_for_test"])


def test_a_users_own_files(tmp_path, here):
    folder = tmp_path / "conf"
    for group in ("experiment", "optimizer"):
        (folder / group).mkdir(parents=True)
    experiment = folder / "experiment" / "mine.yaml"
    experiment.write_text("# @package _global_\ntrainer:\n  max_stepz: 3\n")
    result = here("--config-dir=conf", "experiment=mine")
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1)
    assert "max_steps" in result.stderr
    experiment.write_text(
        "# @package _global_\ndefaults:\n  - override /optimizer: mine\ntrainer: {max_steps: 3}\n"
    )
    (folder / "optimizer" / "mine.yaml").write_text("_target_: torch.optim.NAdam\nlr: 0.5\n")
    result = here("--config-dir=conf", "--cfg", "job", "experiment=mine")
    config = yaml.safe_load(result.stdout)
    assert config["optimizer"].items() >= {"_target_": "torch.optim.NAdam", "lr": 0.5}.items()
    assert config["trainer"]["max_steps"] == 3


def test_known_keys_are_dotted():
    assert {"trainer.max_steps", "activation", "domain", "loss_weights.seam"} <= set(known_keys())
    assert set(parameters(Settings)[0]) - {"surface"} <= {k.partition(".")[0] for k in known_keys()}


class TestFunctions:
    """Settings as arguments of the functions of nsm."""

    @pytest.fixture
    def request_of(self):
        from nsm.api import _Request

        uv = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1], [0, 0]])
        faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
        surface = Surface.from_arrays(np.column_stack([uv, 0 * uv[:, 0]]), faces, cache=False)

        def call(overrides=(), **settings):
            request = _Request("overfit", overrides, settings, [surface])
            with request.run(None, False) as (config, _):
                return config

        return call

    def test_they_are_as_on_the_command_line(self, request_of, mine):
        config = request_of(
            ["data.batch_size=32"],
            activation="silu",
            trainer={"max_steps": 5},
            seed=3,
            experiment="quick",
            optimizer=torch.optim.NAdam,
            loss_terms={"mine": {"_target_": mine.Term, "weight": 2}},
        )
        assert config.activation._target_.endswith("SiLU")
        assert (config.trainer.max_steps, config.seed, config.data.batch_size) == (5, 3, 32)
        assert config.optimizer._target_.endswith("NAdam")
        assert config.loss_terms.mine == {
            "_target_": "mine_for_test.Term",
            "weight": 2.0,
        }
        assert config.trainer.progress is False and config.logger == {}

    @pytest.mark.parametrize(
        ("overrides", "settings", "kind", "key"),
        [
            ([], {"activaton": "silu"}, "unknown_setting", "activaton"),
            ([], {"activation": "sillu"}, "unknown_option", "activation"),
            ([], {"trainer": {"max_step": 3}}, "unknown_setting", "trainer.max_step"),
            ([], {"trainer.max_steps": 3}, "unknown_setting", "trainer.max_steps"),
            ([], {"trainer": 3}, "wrong_type", "trainer"),
            ([], {"seed": "many"}, "wrong_type", "seed"),
            (["seed=1"], {"seed": 2}, "conflicting_settings", "seed"),
            (["trainer.max_steps=1"], {"trainer": {"max_steps": 2}}, "conflicting_settings", None),
            (["resume=x"], {}, "conflicting_settings", "resume"),
            ([], {"task": "param"}, "conflicting_settings", "task"),
            (["surface=cow"], {}, "conflicting_settings", "surface"),
            (["domain=square"], {}, "conflicting_settings", "domain"),
            ("seed=1", {}, "wrong_type", "overrides"),
            ([], {"lambda": "positions"}, "renamed_setting", "lambda"),
            ([], {"map": {"readout": "none"}}, "renamed_setting", "map.readout"),
            ([], {"activation": torch.nn.Mish()}, "wrong_type", "activation"),
        ],
    )
    def test_mistakes(self, request_of, overrides, settings, kind, key):
        with pytest.raises(NsmError) as error:
            request_of(overrides, **settings)
        assert error.value.kind == kind
        assert key is None or error.value.key == key
