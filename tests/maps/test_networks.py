"""Forward-mode Jacobians against torch.func, and the networks' own promises."""

import pytest
import torch

from nsm.maps import ACTIVATIONS, BLOCKS, build_map

ENCODING_CONFIGS = [
    {"name": "identity"},
    {"name": "fourier", "features": 8, "sigma": 1.0},
    {"name": "spline_grid", "resolutions": [4, 9], "features": 3, "degree": 2},
    {"name": "spline_grid", "resolutions": [4, 9], "features": 3, "degree": 3},
]


def points(n: int = 32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return 2 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1


def randomised(config: dict) -> torch.nn.Module:
    """A map in float64 with every parameter random, so that no block is still the identity."""
    torch.manual_seed(0)
    net = build_map(config).double()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(0.3 * torch.randn_like(parameter))
    return net


@pytest.mark.parametrize(
    "encoding", ENCODING_CONFIGS, ids=lambda e: f"{e['name']}{e.get('degree', '')}"
)
def test_a_read_out_adds_a_linear_function_of_the_features(encoding):
    net = randomised({"width": 8, "depth": 1, "encoding": encoding, "linear_skip": "linear"})
    x = points()
    value, jacobian = net.value_and_jacobian(x)
    expected = torch.func.vmap(torch.func.jacfwd(lambda p: net(p[None])[0]))(x)
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-9)
    net.output.weight.data.zero_()
    net.output.bias.data.zero_()
    torch.testing.assert_close(net(x), net.linear_skip(net.encoding(x)), rtol=0, atol=1e-12)
    assert not torch.allclose(value, net(x))


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(
    "encoding", ENCODING_CONFIGS, ids=lambda e: f"{e['name']}{e.get('degree', '')}"
)
def test_agrees_with_jacfwd(block, activation, encoding):
    config = {"width": 16, "depth": 2, "block": block, "encoding": encoding}
    # sin(30 z), the default, in every layer multiplies rounding by a million
    steepness = {"omega": 3.0} if activation == "sine" else {}
    net = randomised({**config, "activation": {"name": activation, **steepness}})
    x = points()
    value, jacobian = net.value_and_jacobian(x)
    expected = torch.func.vmap(torch.func.jacfwd(lambda p: net(p[None])[0]))(x)
    scale = expected.abs().max().clamp(min=1)
    assert jacobian.shape == (32, 3, 2)
    torch.testing.assert_close(value, net(x), rtol=0, atol=1e-10)
    assert ((jacobian - expected).abs().max() / scale) < 1e-10


@pytest.mark.parametrize("linear_skip", ["none", "linear"])
@pytest.mark.parametrize(
    "encoding", ENCODING_CONFIGS, ids=lambda e: f"{e['name']}{e.get('degree', '')}"
)
def test_parameter_gradient_of_a_jacobian_loss(encoding, linear_skip):
    net = randomised({"width": 8, "depth": 1, "encoding": encoding, "linear_skip": linear_skip})
    x = points(6)
    loss = net.value_and_jacobian(x)[1].square().sum()
    loss.backward()
    step = 1e-6
    for parameter in net.parameters():
        flat = parameter.data.view(-1)
        entry = int(parameter.grad.abs().argmax())
        original = flat[entry].item()
        ends = []
        for sign in (1, -1):
            flat[entry] = original + sign * step
            ends.append(net.value_and_jacobian(x)[1].square().sum().item())
        flat[entry] = original
        slope = (ends[0] - ends[1]) / (2 * step)
        assert parameter.grad.view(-1)[entry].item() == pytest.approx(slope, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("degree", [2, 3])
def test_spline_grid_is_smooth_across_cells(degree):
    net = randomised(
        {
            "width": 8,
            "depth": 1,
            "encoding": {
                "name": "spline_grid",
                "resolutions": [4],
                "degree": degree,
                "extent": 1.0,
            },
        }
    )
    wall = torch.tensor([[0.5, 0.2]], dtype=torch.float64)  # a boundary between two cells
    offset = torch.tensor([[1e-9, 0.0]], dtype=torch.float64)
    before, after = (net.value_and_jacobian(wall + side * offset)[1] for side in (-1, 1))
    torch.testing.assert_close(before, after, rtol=0, atol=1e-6)


def test_pre_activation_blocks_begin_as_identity():
    torch.manual_seed(0)
    deep = build_map({"width": 8, "depth": 3, "block": "pre"})
    x = points().float()
    expected = deep.output(deep.activation(deep.input(x)))
    torch.testing.assert_close(deep(x), expected)


def test_siren_keeps_its_spread_with_depth():
    torch.manual_seed(0)
    net = build_map(
        {
            "width": 256,
            "depth": 6,
            "block": "plain",
            "activation": {"name": "sine"},
            "initialization": "siren",
        }
    )
    y = net.activation(net.input(points(2000).float()))
    for block in net.blocks:
        y = block(y)
        assert 0.5 < y.std().item() < 0.9  # arcsine distribution: 1/sqrt(2)


@pytest.mark.parametrize(
    "config",
    [
        {"block": "dense"},
        {"initialization": "zero"},
        {"activation": {"name": "swishh"}},
        {"activation": {"name": "relu", "beta": 2}},
        {"encoding": {"name": "hash"}},
        {"encoding": {"name": "spline_grid", "degree": 5}},
    ],
)
def test_unknown_choices_are_refused(config):
    with pytest.raises(ValueError):
        build_map(config)


def test_config_rebuilds_the_map():
    torch.manual_seed(1)
    net = build_map({"width": 8, "depth": 2, "encoding": {"name": "fourier", "features": 4}})
    again = build_map(net.config)
    again.load_state_dict(net.state_dict())
    x = points().float()
    assert torch.equal(net(x), again(x))
