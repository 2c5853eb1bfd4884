"""Forward-mode Jacobians against torch.func, and the networks' own promises."""

import pytest
import torch
from map_samples import ACTIVATIONS, activation, encoding, network, randomised

from nsm.errors import NotTrusted, NsmError
from nsm.maps import BLOCKS, NeuralMap, as_activation, build_network, build_stored
from nsm.maps.activations import ELU, LeakyReLU, Sine, Softplus
from nsm.maps.encodings import RandomFourierFeatures, SplineGrid

ENCODING_CONFIGS = [
    encoding("Identity"),
    encoding("RandomFourierFeatures", features=8, sigma=1.0),
    encoding("SplineGrid", resolutions=[4, 9], features=3, degree=2),
    encoding("SplineGrid", resolutions=[4, 9], features=3, degree=3),
]


def points(n: int = 32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return 2 * torch.rand(n, 2, generator=generator, dtype=torch.float64) - 1


def name_of(enc: dict) -> str:
    return f"{enc['_target_'].rpartition('.')[2]}{enc.get('degree', '')}"


@pytest.mark.parametrize("enc", ENCODING_CONFIGS, ids=name_of)
def test_a_linear_skip_adds_a_linear_function_of_the_features(enc):
    net = randomised(network(enc=enc, width=8, depth=1, linear_skip="linear"))
    x = points()
    value, jacobian = net.value_and_jacobian(x)
    expected = torch.func.vmap(torch.func.jacfwd(lambda p: net(p[None])[0]))(x)
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-9)
    net.output.weight.data.zero_()
    net.output.bias.data.zero_()
    torch.testing.assert_close(net(x), net.linear_skip(net.encoding(x)), rtol=0, atol=1e-12)
    assert not torch.allclose(value, net(x))


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("name", [*ACTIVATIONS, "torch.nn.Hardswish"])
@pytest.mark.parametrize("enc", ENCODING_CONFIGS, ids=name_of)
def test_agrees_with_jacfwd(block, name, enc):
    # sin(30 z), the default, in every layer multiplies rounding by a million
    steepness = {"omega": 3.0} if name == "Sine" else {}
    act = {"_target_": name} if "." in name else activation(name, **steepness)
    net = randomised(network(act, enc, width=16, depth=2, block=block))
    x = points()
    value, jacobian = net.value_and_jacobian(x)
    expected = torch.func.vmap(torch.func.jacfwd(lambda p: net(p[None])[0]))(x)
    scale = expected.abs().max().clamp(min=1)
    assert jacobian.shape == (32, 3, 2)
    torch.testing.assert_close(value, net(x), rtol=0, atol=1e-10)
    assert ((jacobian - expected).abs().max() / scale) < 1e-10


@pytest.mark.parametrize("linear_skip", ["none", "linear"])
@pytest.mark.parametrize("enc", ENCODING_CONFIGS, ids=name_of)
def test_parameter_gradient_of_a_jacobian_loss(enc, linear_skip):
    net = randomised(network(enc=enc, width=8, depth=1, linear_skip=linear_skip))
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
    grid = encoding("SplineGrid", resolutions=[4], degree=degree, extent=1.0)
    net = randomised(network(enc=grid, width=8, depth=1))
    wall = torch.tensor([[0.5, 0.2]], dtype=torch.float64)  # a boundary between two cells
    offset = torch.tensor([[1e-9, 0.0]], dtype=torch.float64)
    before, after = (net.value_and_jacobian(wall + side * offset)[1] for side in (-1, 1))
    torch.testing.assert_close(before, after, rtol=0, atol=1e-6)


def test_pre_activation_blocks_begin_as_identity():
    torch.manual_seed(0)
    deep = NeuralMap(width=8, depth=3, block="pre")
    x = points().float()
    expected = deep.output(deep.activation(deep.input(x)))
    torch.testing.assert_close(deep(x), expected)


def test_frozen_network_that_adds_nothing_is_left_out():
    """As of a fit alone; what comes is what the whole network would give, gradients by x too."""
    enc = encoding("SplineGrid", resolutions=[3, 5], features=2)
    net = randomised(network(enc=enc, width=8, depth=1, linear_skip="linear"))
    for parameter in net.output.parameters():
        torch.nn.init.zeros_(parameter)
    x = points(6).requires_grad_()
    whole = (net(x), *net.value_and_jacobian(x))  # its weights could be trained
    net.requires_grad_(False)
    net.input.register_forward_hook(lambda *_: pytest.fail("it was evaluated"))
    alone = (net(x), *net.value_and_jacobian(x))
    for one, other in zip(alone, whole, strict=True):
        torch.testing.assert_close(one, other)
        gradients = (
            torch.autograd.grad(y.square().sum(), x, retain_graph=True) for y in (one, other)
        )
        torch.testing.assert_close(*(g[0] for g in gradients))


def test_siren_keeps_its_spread_with_depth():
    torch.manual_seed(0)
    net = NeuralMap(3, 256, 6, "plain", activation=Sine(), initialization="siren")
    y = net.activation(net.input(points(2000).float()))
    for block in net.blocks:
        y = block(y)
        assert 0.5 < y.std().item() < 0.9  # arcsine distribution: 1/sqrt(2)


@pytest.mark.parametrize(
    "make",
    [
        lambda: NeuralMap(block="dense"),
        lambda: NeuralMap(initialization="zero"),
        lambda: NeuralMap(linear_skip="curved"),
        lambda: NeuralMap(width=0),
        lambda: Softplus(beta=0.0),
        lambda: Softplus(beta=-1.0),
        lambda: Softplus(beta=float("nan")),
        lambda: Sine(omega=0),
        lambda: ELU(alpha=0),
        lambda: LeakyReLU(negative_slope=-0.1),
        lambda: SplineGrid(degree=5),
        lambda: SplineGrid(resolutions=[]),
        lambda: SplineGrid(features=0),
        lambda: RandomFourierFeatures(features=0),
    ],
)
def test_parameters_out_of_range_are_refused(make):
    with pytest.raises(ValueError):
        make()


@pytest.mark.parametrize(
    ("parts", "kind", "key"),
    [
        ({"encoding": torch.nn.Identity()}, "wrong_type", "encoding"),
        ({"activation": 3.0}, "wrong_type", "activation"),
        ({"activation": lambda z: z.sum()}, "wrong_shape", "activation"),
    ],
)
def test_what_is_no_part_of_a_network_is_refused(parts, kind, key):
    with pytest.raises(NsmError) as error:
        NeuralMap(**parts)
    assert (error.value.kind, error.value.key) == (kind, key)


@pytest.mark.parametrize(
    ("settings", "kind", "key"),
    [
        ({"activation": activation("Softplus", beta=0)}, "not_instantiable", None),
        ({"activation": activation("ReLU", beta=2)}, "not_instantiable", None),
        ({"activation": activation("Swishh")}, "not_instantiable", None),
        ({"encoding": {"_target_": "torch.nn.Tanh"}}, "wrong_type", "encoding"),
        ({"map": {"block": "dense"}}, "not_instantiable", "nsm.maps.NeuralMap"),
    ],
)
def test_settings_out_of_range_are_refused(settings, kind, key):
    with pytest.raises(NsmError) as error:
        build_network(**settings)
    assert error.value.kind == kind and (key is None or error.value.key == key)


@pytest.mark.parametrize("name", ["torch.nn.Mish", "torch.nn.PReLU"])
def test_config_rebuilds_the_map(name):
    torch.manual_seed(1)
    fourier = encoding("RandomFourierFeatures", features=4)
    net = network({"_target_": name}, fourier, width=8, depth=2)
    again = build_stored(net.config).double()
    assert again.config == net.config
    again.load_state_dict(net.state_dict())
    assert torch.equal(net(points()), again(points()))


def test_stored_settings_name_no_code_of_others():
    config = NeuralMap(activation=torch.sin).config
    for part in ({"activation": {"_target_": "os.getcwd"}}, {"_target_": "os.getcwd"}):
        with pytest.raises(NotTrusted):
            build_stored({**config, **part})


@pytest.mark.parametrize("function", [torch.sin, torch.nn.Mish(), torch.nn.functional.softsign])
def test_any_function_is_an_activation(function):
    net = randomised(NeuralMap(width=5, depth=2, block="post", activation=function).double())
    value, jacobian = net.value_and_jacobian(points())
    expected = torch.func.vmap(torch.func.jacrev(lambda p: net(p[None])[0]))(points())
    torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-12)


def test_an_activation_with_parameters_is_trained():
    net = randomised(network({"_target_": "torch.nn.PReLU"}, width=5, depth=2))
    net.value_and_jacobian(points())[1].square().sum().backward()
    assert net.activation.function.weight.grad.abs().sum() > 0


def test_an_activation_of_ours_stays_as_it_is():
    sine = Sine(omega=2.0)
    assert as_activation(sine) is sine


def test_a_network_and_an_encoding_of_the_user():
    net = build_network(
        {"_target_": "map_samples.Net", "width": 5},
        activation("Tanh"),
        {"_target_": "map_samples.Polar"},
        out_dim=2,
    ).double()
    value, jacobian = net.value_and_jacobian(points())
    expected = torch.func.vmap(torch.func.jacrev(lambda p: net(p[None])[0]))(points())
    torch.testing.assert_close(jacobian, expected)
    again = build_stored(net.config, trust=["map_samples"]).double()
    again.load_state_dict(net.state_dict())
    assert torch.equal(again(points()), value)
    ours = randomised(network(enc={"_target_": "map_samples.Polar"}, width=5, depth=1))
    expected = torch.func.vmap(torch.func.jacrev(lambda p: ours(p[None])[0]))(points())
    torch.testing.assert_close(ours.value_and_jacobian(points())[1], expected)


@pytest.mark.parametrize("enc", ENCODING_CONFIGS, ids=name_of)
@pytest.mark.parametrize("block", BLOCKS)
def test_transforms_of_torch_func(block, enc):
    net, x = (
        randomised(network(enc=enc, width=6, depth=2, block=block, linear_skip="linear")),
        points(5),
    )
    value, jacobian = net.value_and_jacobian(x)
    one_by_one = torch.func.vmap(lambda p: tuple(t[0] for t in net.value_and_jacobian(p[None])))(x)
    torch.testing.assert_close(one_by_one, (value, jacobian))
    second = torch.func.vmap(torch.func.jacrev(lambda p: net.value_and_jacobian(p[None])[1][0]))(x)
    expected = torch.func.vmap(torch.func.hessian(lambda p: net(p[None])[0]))(x)
    torch.testing.assert_close(second, expected)

    def loss(parameters, x):
        value, jacobian = torch.func.functional_call(Jacobian(net), parameters, (x,))
        return (value.sum(dim=1) * jacobian.square().sum(dim=(1, 2))).sum()

    parameters = {f"map.{name}": p.detach() for name, p in net.named_parameters()}
    gradients = torch.func.grad(loss)(parameters, x)
    (value.sum(dim=1) * jacobian.square().sum(dim=(1, 2))).sum().backward()
    for name, p in net.named_parameters():
        torch.testing.assert_close(gradients[f"map.{name}"], p.grad, rtol=1e-9, atol=1e-9)


class Jacobian(torch.nn.Module):
    def __init__(self, map_):
        super().__init__()
        self.map = map_

    def forward(self, x):
        return self.map.value_and_jacobian(x)
