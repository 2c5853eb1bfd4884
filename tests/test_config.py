"""The configuration: every file composes, and mistakes are told in one line."""

import inspect

import pytest
import torch

from nsm.config import compose_config, conf_folder, known_keys
from nsm.config_validation import TASK_CHOICES, named
from nsm.errors import NsmError
from nsm.pipeline import TASKS
from nsm.surfaces import catalogue_names

FILES = sorted(
    (str(file.parent.relative_to(conf_folder())), file.stem)
    for file in conf_folder().rglob("*.yaml")
    if file.parent != conf_folder()
)
# what an option of these groups means depends on the task
FOR_TASK = {
    "energy": lambda name: "overfit" if name == "overfit" else "param",
    "constraints": lambda name: "param" if name == "param" else "pair_map",
    "loss_weights": lambda name: {"param": "param"}.get(
        name, "pair_map" if "pair" in name else "overfit"
    ),
    "experiment": lambda name: "pair_map" if name == "paper_pair" else "overfit",
}


@pytest.mark.parametrize(("group", "name"), FILES)
def test_every_file_composes(group, name, monkeypatch):
    monkeypatch.setattr("nsm.config_validation.require", lambda kind: None)  # packages of loggers
    task = FOR_TASK.get(group, lambda name: "overfit")(name)
    words = [f"{group}={name}"] if group == "task" else [f"task={task}", f"{group}={name}"]
    config = compose_config(words)
    assert config.domain == ("square" if name == "square" else "disc")
    if group in named():
        assert config[group].name in named()[group]


def test_every_known_choice_is_an_option():
    """Nothing that the code offers is out of reach of GROUP=OPTION."""
    for group, known in named().items():
        options = [name for g, name in FILES if g == group]
        assert {compose_config([f"{group}={o}"])[group].name for o in options} == set(known)
    assert set(TASK_CHOICES) == set(TASKS) == {name for g, name in FILES if g == "task"}


def test_optimizers_take_what_torch_takes():
    assert set(named()["optimizer"]["sgd"]) == {
        *inspect.signature(torch.optim.SGD).parameters,
        "encoding_lr",
    } - {"params"}


def test_the_check_leaves_no_trace_in_the_random_numbers():
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    compose_config(["map=residual"])
    assert torch.equal(torch.rand(3), expected)


def test_groups_can_be_changed_apart():
    config = compose_config(["task=pair_map", "data=paper", "loss_weights=paper_pair"])
    assert (config.data.batch_size, config.data.pool) == (4000, 500_000)
    assert config.constraints.boundary == "exact"
    assert config.constraints.lambda_seam == 0
    config = compose_config(["task=pair_map", "data=paper", "sampler=fresh", "domain=square"])
    assert (config.data.batch_size, config.data.pool, config.domain) == (4000, None, "square")
    config = compose_config(["task=pair_map", "constraints=paper_pair", "loss_weights=pair"])
    assert (config.constraints.boundary, config.constraints.lambda_seam) == ("penalty", 1e3)


@pytest.mark.parametrize(
    ("words", "linear_skip", "steps"),
    [
        ([], "fitted", 1000),
        (["map=residual"], "fitted", 1000),
        (["initialization=random"], "none", 8000),
        (["encoding=fourier"], "none", 8000),
        (["encoding=identity"], "none", 8000),
        (["encoding=fourier", "initialization=fitted"], "fitted", 1000),
        (["experiment=paper"], "none", 50_000),
        (["sweep=activation"], "none", 8000),
        (["task=param"], "none", 2000),
        (["task=pair_map", "encoding=fourier"], "none", 1500),
    ],
)
def test_only_what_can_be_fitted_starts_so(words, linear_skip, steps):
    """What has no grid to fit, or no surface, starts at random, at full rates."""
    config = compose_config(words)
    assert (config.map.linear_skip, config.trainer.max_steps) == (linear_skip, steps)
    assert config.scheduler.get("peak", 1.0) == (0.003 if linear_skip == "fitted" else 1.0)


def test_the_surface_group_is_the_catalogue():
    files = {name for group, name in FILES if group == "surface"} - {"base"}
    assert files == set(catalogue_names())
    for name in files:
        assert compose_config([f"surface={name}"]).surface.name == name


def test_paper_settings_are_those_of_the_paper():
    config = compose_config(["experiment=paper"])
    assert (config.map.width, config.map.depth, config.map.block) == (256, 10, "post")
    assert config.map.initialization == "xavier"
    assert dict(config.activation) == {"name": "softplus", "beta": 1.0}
    assert config.encoding.name == "identity"
    assert config.energy.lambda_normal == 0.01
    assert (config.optimizer.name, config.optimizer.lr) == ("rmsprop", 1e-4)
    assert config.optimizer.momentum == 0.9
    assert config.scheduler.name == "sgdr"
    assert (config.data.batch_size, config.data.pool) == (4000, 500_000)
    assert config.trainer.stop_gradient_norm == 0.1


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("trainer.max_step=10", "'trainer.max_steps'"),
        ("+trainer.max_step=10", "'trainer.max_steps'"),
        ("activaton=silu", "'activation'"),
        ("activation=sillu", "'silu'"),
        ("surface=bunnny", "'bunny'"),
        ("domain=squre", "'square'"),
        ("loss_weights=positons", "'positions'"),
        ("trainer.max_steps=many", "trainer.max_steps"),
        ("trainer.accelerator=gppu", "'gpu'"),
        ("data.batch_size=0", "data.batch_size"),
        ("data.vertex_share=2", "data.vertex_share"),
        ("data.domain_share=0.95", "data.domain_share"),
        ("trainer.precision=half", "float32, tf32, bf16"),
        ("trainer.max_steps=[", "trainer.max_steps=["),
        ("map.block=pots", "'post'"),
        ("surface.parameterization=slimm", "'slim'"),
        ("phi.overrides=['map.widht=3']", "'map.width'"),
        # inside the groups whose keys depend on the choice
        ("activation.bta=3", "'beta'"),
        ("+activation.bta=3", "'beta'"),
        ("activation=relu +activation.beta=3", "takes no such setting"),
        ("activation.beta=soft", "not a number"),
        ("encoding.feature=4", "'features'"),
        ("encoding.features=2.5", "not a whole number"),
        ("encoding.resolutions=[]", "one level or more"),
        ("encoding.resolutions=[8,0]", "1 cell or more"),
        ("encoding.extent=0", "must be positive"),
        ("encoding.extent=nan", "no finite number"),
        ("optimizer.encoding_lr=-1", "negative"),
        ("scheduler.warmup=-1", "negative"),
        ("seed=-1", "not at least 0"),
        ("seed=4294967296", "more than"),
        ("data.pool=0", "not at least 1"),
        ("data.steps_per_epoch=9223372036854775808", "too large"),
        ("encoding.resolutions=[16,many]", "each item a whole number"),
        ("encoding.degree=7", "degree 2 or 3"),
        ("+optimizer.weight_decy=0.1", "'weight_decay'"),
        ("optimizer=rmsprop optimizer.momentun=0.1", "'momentum'"),
        ("optimizer.momentum=0.1", "optimizer=adam takes no such setting"),
        ("optimizer.weight_decay=0.1", "+optimizer.weight_decay=0.1"),
        ("optimizer.lr=fast", "not a number"),
        ("optimizer.betas=[2,3]", "setting optimizer: "),
        ("scheduler=sgdr scheduler.periode=9", "'period'"),
        ("scheduler=sgdr scheduler.period=0", "positive"),
        ("energy.lambda_norml=1", "'lambda_normal'"),
        ("energy=conformal", "task=overfit takes no such setting"),
        ("constraints=pair", "task=overfit has none"),
        ("task=param +energy.weights.arpa=1", "'area'"),
        ("task=param energy.weights.symmetric_dirichlet=[]", "not a number"),
        ("task=param constraints.bondary=fixed", "'boundary'"),
        ("task=param constraints.boundary=fixd", "'fixed'"),
        ("task=pair_map constraints.ramp=3", "constraints.ramp"),
        ("task=pair_map constraints.multiplier_every=often", "not a whole number"),
        ("task=pair_map loss_weights=param", "constraints.lambda_boundary"),
        ("+optimizer.lr=1", "leave out the +"),
    ],
)
def test_mistakes_are_one_line_that_helps(words, expected):
    with pytest.raises(NsmError) as error:
        compose_config(words.split())
    assert "\n" not in str(error.value)
    assert expected in str(error.value)


def test_misspelt_keys_of_ones_own_files_are_told(tmp_path, here):
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    file = tmp_path / "conf" / "experiment" / "mine.yaml"
    file.write_text("# @package _global_\ntrainer:\n  max_stepz: 3\n")
    result = here("--config-dir=conf", "experiment=mine")
    assert result.returncode == 2
    assert "'trainer.max_steps'" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_known_keys_are_dotted():
    assert {"trainer.max_steps", "activation", "domain", "constraints.lambda_seam"} <= set(
        known_keys()
    )
