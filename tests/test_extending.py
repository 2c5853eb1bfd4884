"""What users register, and the page that shows how: its examples run as they stand."""

import re
from pathlib import Path

import pytest
import torch

import nsm
from nsm.config import compose_config
from nsm.energies import ENERGIES, energy
from nsm.maps import ACTIVATIONS, ANALYTIC, BLOCKS, ENCODINGS, build_analytic, build_map

PAGE = Path(__file__).parent.parent / "docs" / "extending.md"
EXAMPLES = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.S | re.M)


@pytest.fixture(scope="module")
def page():
    """The names that the page's examples leave, run in turn as a reader would."""
    tables = (ENERGIES, ACTIVATIONS, ENCODINGS, BLOCKS, ANALYTIC)
    before = [dict(table) for table in tables]
    names: dict = {"__name__": "page"}
    for block in EXAMPLES:
        assert len([line for line in block.splitlines() if line.strip()]) < 15
        if "nsm.cli" not in block:
            exec(block, names)
    yield names
    for table, old in zip(tables, before, strict=True):
        table.clear()
        table.update(old)


def metrics(count):
    jacobian = torch.randn(2, count, 3, 2, dtype=torch.float64)
    return jacobian.transpose(-1, -2) @ jacobian


def test_energy_is_what_its_formula_says(page):
    source, target = metrics(50)
    squared = torch.linalg.eigvals(torch.linalg.solve(source, target)).real
    expected = ((squared.log() / 2) ** 2).sum(dim=-1)
    assert torch.allclose(energy("hencky")(source, target), expected, rtol=1e-4)
    assert page["flat"].config["energy"]["weights"] == {"hencky": 1.0}
    assert page["flat"].metrics["nsm"]["flipped_percent"] == 0


@pytest.mark.parametrize(
    "part",
    [
        {"activation": {"name": "swish", "beta": 2.0}},
        {"encoding": {"name": "waves", "octaves": 3}},
        {"block": "highway", "encoding": {"name": "spline_grid", "resolutions": [4]}},
    ],
    ids=["activation", "encoding", "block"],
)
def test_jacobians_and_their_gradients(page, part):
    net = build_map({"width": 3, "depth": 1, "block": "pre", **part}).double()
    x = torch.rand(2, 2, dtype=torch.float64, requires_grad=True)
    expected = torch.func.vmap(torch.func.jacfwd(lambda p: net(p[None])[0]))(x)
    assert torch.allclose(net.value_and_jacobian(x)[1], expected)
    assert torch.autograd.gradcheck(lambda x, *_: net.value_and_jacobian(x), (x, *net.parameters()))


def test_an_encoding_of_ones_own_starts_at_random(page):
    assert compose_config(["encoding=waves"]).map.linear_skip == "none"
    assert compose_config(["encoding=waves", "initialization=fitted"]).map.linear_skip == "fitted"


def test_analytic_jacobian(page):
    dune = build_analytic({"name": "dune", "height": 0.4})
    x = torch.rand(6, 2, dtype=torch.float64)
    expected = torch.func.vmap(torch.func.jacfwd(lambda p: dune(p[None])[0]))(x)
    assert torch.allclose(dune.value_and_jacobian(x)[1], expected)
    with pytest.raises(nsm.NsmError, match="dune: .*'width'"):
        build_analytic({"name": "dune", "width": 1})


def test_a_saved_network_of_ones_own_needs_its_registration(page, tmp_path, monkeypatch):
    uv = torch.rand(5, 2)
    for name, table, register in (
        ("swished", "ACTIVATIONS", "register_activation"),
        ("waved", "ENCODINGS", "register_encoding"),
        ("gated", "BLOCKS", "register_block"),
    ):
        page[name].save(tmp_path)
        assert torch.equal(nsm.load(tmp_path)(uv), page[name](uv))
        with monkeypatch.context() as patch:
            builtin = {"softplus": None, "spline_grid": None, "plain": None}
            patch.setattr(f"nsm.results.networks.{table}", builtin)
            with pytest.raises(nsm.NsmError, match=f"call nsm.{register} first"):
                nsm.load(tmp_path)


def test_names_that_cannot_be_taken():
    with pytest.raises(nsm.NsmError, match="'arap' is there already"):
        nsm.register_energy("arap", lambda m: m.trace)
    with pytest.raises(nsm.NsmError, match="lower case"):
        nsm.register_energy("../mine", lambda m: m.trace)
    with pytest.raises(nsm.NsmError, match="one finite number"):
        nsm.register_energy("mean", lambda m: m.trace.mean())
    with pytest.raises(nsm.NsmError, match="c needs a number"):
        nsm.register_activation("mine", lambda z, c: z)


def test_settings_of_ones_own_are_checked(page):
    with pytest.raises(nsm.NsmError, match="did you mean 'beta'"):
        compose_config(["activation=swish", "+activation.bta=2"])
