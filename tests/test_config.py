"""The configuration: every file composes, and mistakes are told in one line."""

import pytest

from nsm.config import compose_config, conf_folder, known_keys
from nsm.errors import NsmError
from nsm.surfaces import catalogue_names

FILES = sorted(
    (file.parent.name, file.stem)
    for file in conf_folder().rglob("*.yaml")
    if file.parent != conf_folder()
)


@pytest.mark.parametrize(("group", "name"), FILES)
def test_every_file_composes(group, name):
    config = compose_config([f"{group}={name}"])
    if group in config:
        assert config[group] is not None


def test_the_surface_group_is_the_catalogue():
    files = {name for group, name in FILES if group == "surface"} - {"base"}
    assert files == set(catalogue_names())
    for name in files:
        assert compose_config([f"surface={name}"]).surface.name == name


def test_paper_settings_are_those_of_the_paper():
    config = compose_config(["experiment=paper"])
    assert (config.map.width, config.map.depth, config.map.block) == (256, 10, "post")
    assert config.map.initialisation == "xavier"
    assert dict(config.activation) == {"name": "softplus", "beta": 1.0}
    assert config.encoding.name == "identity"
    assert config.energy.lambda_normal == 0.01
    assert (config.optimizer.name, config.optimizer.lr) == ("rmsprop", 1e-4)
    assert config.optimizer.momentum == 0.9
    assert config.scheduler.name == "sgdr"
    assert (config.data.batch_size, config.data.pool) == (4000, 500_000)
    assert config.trainer.stop_gradient_norm == 0.1


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("trainer.max_step=10", "trainer.max_steps"),
        ("activaton=silu", "activation"),
        ("activation=sillu", "silu"),
        ("surface=bunnny", "bunny"),
        ("trainer.max_steps=many", "trainer.max_steps"),
        ("data.batch_size=0", "data.batch_size"),
        ("data.vertex_share=2", "data.vertex_share"),
        ("trainer.max_steps=[", "["),
    ],
)
def test_mistakes_are_one_line_that_helps(override, expected):
    with pytest.raises(NsmError) as error:
        compose_config([override])
    assert "\n" not in str(error.value)
    assert expected in str(error.value)


def test_known_keys_are_dotted():
    assert "trainer.max_steps" in known_keys()
    assert "activation" in known_keys()
