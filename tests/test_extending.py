"""What users write themselves, and the page that shows how: its examples run as they stand."""

import re
import sys
import types
from pathlib import Path

import pytest
import torch
from doc_pages import short_trainings
from hydra.core.config_store import ConfigStore
from torch import nn

import nsm
from nsm import extensions
from nsm.config import compose_config, composed
from nsm.errors import NsmError
from nsm.instantiation import check_trusted, made
from nsm.maps import ANALYTIC, BLOCKS

PAGE = (Path(__file__).parent.parent / "docs" / "extending.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```python\n(.*?)^```$", PAGE, re.S | re.M)


@pytest.fixture(scope="module", autouse=True)
def tables():
    """What is registered here is forgotten afterwards."""
    before = [dict(table) for table in (ANALYTIC, BLOCKS)]
    repo = {group: dict(options) for group, options in ConfigStore.instance().repo.items()
            if isinstance(options, dict)}  # fmt: skip
    yield
    for table, old in zip((ANALYTIC, BLOCKS), before, strict=True):
        table.clear()
        table.update(old)
    for group in ("activation", "encoding", "energy"):
        ConfigStore.instance().repo[group] = repo.get(group, {})
    extensions._KINDS.clear()


@pytest.fixture(scope="module")
def page():
    """The names that the page's examples leave, run in turn as a reader would."""
    module = types.ModuleType("mine")
    sys.modules["mine"] = module
    with short_trainings():
        for block in EXAMPLES:
            exec(block, module.__dict__)
    yield module.__dict__
    del sys.modules["mine"]


@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
def test_an_example_is_short(example):
    assert len([line for line in example.splitlines() if line.strip()]) < 22


RESULTS = {
    "above": "loss_terms.floor",
    "swished": "activation",
    "waved": "encoding",
    "small": "map",
    "upper": "sampler",
    "noisy": "data",
    "there": "domain",
    "robust": "task",
    "nadam": "optimizer",
}


@pytest.mark.parametrize(("name", "group"), RESULTS.items())
def test_the_class_is_what_the_run_used(page, name, group):
    node = page[name].config
    for key in group.split("."):
        node = node[key]
    assert node["_target_"].startswith(("mine.", "torch.optim"))
    assert all(value == value for value in page[name].metrics.values())


def test_the_energy_is_what_its_formula_says(page):
    jacobian = torch.randn(2, 50, 3, 2, dtype=torch.float64)
    source, target = jacobian.transpose(-1, -2) @ jacobian
    squared = torch.linalg.eigvals(torch.linalg.solve(source, target)).real
    expected = ((squared.log() / 2) ** 2).sum(dim=-1)
    assert torch.allclose(page["Hencky"]()(source, target), expected, rtol=1e-4)
    assert page["flat"].metrics["nsm"]["flipped_percent"] == 0


@pytest.mark.parametrize("name", ["swished", "waved", "gated", "small"])
def test_jacobians_of_foreign_parts(page, name):
    net = page[name].map.double()
    x = torch.rand(2, 2, dtype=torch.float64)
    expected = torch.func.vmap(torch.func.jacfwd(lambda p: net(p[None])[0]))(x)
    assert torch.allclose(net.value_and_jacobian(x)[1], expected)
    net.float()


@pytest.mark.parametrize("name", ["swished", "waved", "small"])
def test_a_saved_network_needs_trust(page, name, tmp_path):
    uv = torch.rand(5, 2)
    page[name].save(tmp_path)
    with pytest.raises(NsmError) as error:
        nsm.load(tmp_path)
    assert error.value.kind == "not_trusted"
    for trust in ("mine", ["mine"]):
        assert torch.equal(nsm.load(tmp_path, trust=trust)(uv), page[name](uv))


def test_a_saved_network_with_a_registered_name(page, tmp_path, monkeypatch):
    uv = torch.rand(5, 2)
    page["named"].save(tmp_path)
    assert torch.equal(nsm.load(tmp_path)(uv), page["named"](uv))
    with monkeypatch.context() as patch:
        patch.delattr(extensions.registered, "softsine")
        with pytest.raises(NsmError):
            nsm.load(tmp_path)


def test_the_commands_of_the_page_compose(page):
    text = re.sub(r"^```.*?^```$", "", PAGE, flags=re.S | re.M)
    commands = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]
    commands = [one for one in commands if re.search(r"_target_=(mine|torch)\.", one)]
    assert len(commands) >= 6
    for command in commands:
        task = ["task=param"] if command.startswith("energy") else []
        compose_config([*task, *command.split()])


@pytest.mark.parametrize(
    ("name", "activation"),
    [
        ("s", torch.sin),
        ("m", nn.Mish()),
        ("c", nn.CELU),
        ("l", lambda z, beta=1.5: z * torch.sigmoid(beta * z)),
    ],
)
def test_any_activation_can_be_registered(name, activation):
    nsm.register_activation(name, activation)
    config = compose_config([f"activation={name}"])
    check_trusted(dict(config.activation))
    module = made(config.activation)
    z = torch.linspace(-1, 1, 5)
    expected = activation()(z) if isinstance(activation, type) else activation(z)
    assert torch.equal(module(z), expected)
    assert made(config.activation) is not module
    if name == "l":
        assert compose_config(["activation=l", "activation.beta=2"]).activation.beta == 2
        with pytest.raises(NsmError) as error:
            compose_config(["activation=l", "activation.bta=2"])
        assert error.value.kind == "unknown_setting"


def test_registering_again_replaces():
    nsm.register_activation("again", lambda z: z)
    nsm.register_activation("again", lambda z: 2 * z)
    assert made(compose_config(["activation=again"]).activation)(torch.ones(1)) == 2


def test_a_registered_encoding_starts_at_random():
    class Waves(nn.Module):
        def __init__(self, octaves: int = 3):
            super().__init__()
            self.out_dim = 2

        def forward(self, x):
            return x

    nsm.register_encoding("waves", Waves)
    assert composed(["encoding=waves"])[0].map.get("linear_skip", "none") == "none"
    config = compose_config(["encoding=waves", "encoding.octaves=6"])
    assert config.encoding.octaves == 6


def test_a_registered_energy():
    nsm.register_energy("stretch", lambda m: m.trace)
    energy = made(compose_config(["task=param", "energy=stretch"]).energy)
    same = torch.eye(2).expand(3, 2, 2)
    assert torch.allclose(energy(same, same).double(), torch.full((3,), 2.0).double())


@pytest.mark.parametrize(
    ("register", "name", "thing", "kind"),
    [
        ("energy", "arap", lambda m: m.trace, "name_taken"),
        ("block", "pre", nn.Linear, "name_taken"),
        ("analytic", "plane", lambda u, v: (u, v, u), "name_taken"),
        ("energy", "../mine", lambda m: m.trace, "invalid_name"),
        ("energy", "mean", lambda m: m.trace.mean(), "wrong_shape"),
        ("activation", "mine", lambda z, c: z, "missing_default"),
    ],
)
def test_what_cannot_be_registered(register, name, thing, kind):
    with pytest.raises(NsmError) as error:
        getattr(nsm, f"register_{register}")(name, thing)
    assert (error.value.kind, error.value.key) == (kind, name)
