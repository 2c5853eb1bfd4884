"""Optimizers and schedules from settings."""

import copy
import math

import pytest
import torch

from nsm.errors import NsmError
from nsm.maps.networks import build_network
from nsm.tasks.joint_optimizer import Shares, in_one, shared_options
from nsm.tasks.optimizers import build_optimizer
from nsm.tasks.schedules import build_scheduler

GRID = {"_target_": "nsm.maps.encodings.SplineGrid", "resolutions": [2, 4]}
ADAM, MUON = "torch.optim.Adam", "nsm.tasks.optimizers.MuonBesideAdam"


def network_of(depth=1, width=8, block="pre", **map):
    return build_network(
        map={
            "_target_": "nsm.maps.NeuralMap",
            "width": width,
            "depth": depth,
            "block": block,
            **map,
        },
        activation={"_target_": "nsm.maps.activations.Softplus", "beta": 10.0},
        encoding=GRID,
        out_dim=3,
    )


def schedule(name, **settings):
    return {"_target_": f"nsm.tasks.schedules.{name}", **settings}


def rates(settings, max_steps, steps):
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=1.0)
    scheduler = build_scheduler(optimizer, settings, max_steps)
    out = []
    for _ in range(steps):
        out.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return out


def test_sgdr_restarts_with_growing_periods():
    lr = rates(schedule("SGDR", period=10, period_factor=2.0), 70, 40)
    assert lr[0] == lr[10] == lr[30] == 1.0
    assert lr[5] == pytest.approx(0.5)
    assert lr[20] == pytest.approx(0.5)  # the middle of the second, longer period
    assert max(lr[1:10]) < 1.0


@pytest.mark.parametrize("max_steps", [7, 10, 33, 100, 1000])
@pytest.mark.parametrize("factor", [1.0, 1.5, 2.0])
def test_the_last_wave_of_sgdr_ends_with_the_training(max_steps, factor):
    settings = schedule("SGDR", period=10, period_factor=factor)
    lr = rates(settings, max_steps, max_steps)
    assert lr[-1] < 0.1
    assert lr[-1] <= min(lr[-3:])
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    scheduler = build_scheduler(optimizer, settings, max_steps)
    assert scheduler.wave_ends(max_steps)
    falls = [k for k in range(1, max_steps) if lr[k] > lr[k - 1]]  # restarts
    assert [k for k in range(max_steps) if scheduler.wave_ends(k)] == falls
    # waves are stretched by less than the square root of the largest step between two totals
    assert 10 / 3 < scheduler.first < 30 or max_steps < 10


def test_a_cosine_may_end_before_the_training():
    part, whole = (rates(schedule("Cosine", final=0.1, **p), 50, 51) for p in ({"until": 0.5}, {}))
    assert part[:26] == pytest.approx(whole[:51:2])
    assert part[25:] == pytest.approx([0.1] * 26)


def test_cosine_falls_to_its_final_share():
    lr = rates(schedule("Cosine", final=0.1), 50, 51)
    assert lr[0] == 1.0
    assert lr[25] == pytest.approx(0.55)
    assert lr[50] == pytest.approx(0.1)
    assert all(a > b for a, b in zip(lr, lr[1:], strict=False))


def test_warmup_rises_linearly():
    lr = rates(schedule("Constant", warmup=4), 50, 8)
    assert lr == pytest.approx([0.2, 0.4, 0.6, 0.8, 1, 1, 1, 1])


def test_the_peak_is_a_share_of_the_rate():
    full, low = (rates(schedule("Cosine", warmup=4, **p), 50, 20) for p in ({}, {"peak": 0.01}))
    assert low == pytest.approx([0.01 * rate for rate in full])


def test_feature_grids_take_their_own_rate():
    network = network_of()
    optimizer = build_optimizer(network, {"_target_": ADAM, "lr": 1e-3, "encoding_lr": 1e-2})
    by_rate = {g["lr"]: sum(p.numel() for p in g["params"]) for g in optimizer.param_groups}
    assert by_rate[1e-2] == sum(p.numel() for p in network.encoding.parameters())
    assert sum(by_rate.values()) == sum(p.numel() for p in network.parameters())


@pytest.mark.parametrize(
    ("settings", "kind"),
    [
        ({"_target_": "torch.optim.Adamm", "lr": 1e-3}, "not_importable"),
        ({"_target_": ADAM, "lr": 1e-3, "momentumm": 0.9}, "not_instantiable"),
        ({"_target_": ADAM, "lr": 1e-3, "encoding_lr": -1.0}, "out_of_range"),
    ],
)
def test_settings_of_no_optimizer_are_refused(settings, kind):
    with pytest.raises(NsmError) as error:
        build_optimizer(torch.nn.Linear(2, 2), settings)
    assert error.value.kind == kind


@pytest.mark.parametrize("target", ["NAdam", "RAdam", "Adagrad", "Adamax"])
def test_any_optimizer_of_torch_works(target):
    network = network_of()
    settings = {"_target_": f"torch.optim.{target}", "lr": 1e-2, "encoding_lr": 3e-2}
    optimizer = build_optimizer(network, settings)
    assert [group["lr"] for group in optimizer.param_groups] == [1e-2, 3e-2]
    with_gradients(optimizer, network, 1)


def test_any_scheduler_of_torch_works():
    lr = rates({"_target_": "torch.optim.lr_scheduler.StepLR", "step_size": 2, "gamma": 0.1}, 9, 4)
    assert lr == pytest.approx([1, 1, 0.1, 0.1])


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        (schedule("SGDR", period_factor=0.5), "scheduler.period_factor"),
        (schedule("SGDR", period=0), "scheduler.period"),
        (schedule("Cosine", warmup=-1), "scheduler.warmup"),
        (schedule("Constant", peak=float("nan")), "scheduler.peak"),
    ],
)
def test_a_schedule_that_could_not_end_is_refused(settings, key):
    with pytest.raises(NsmError) as error:
        rates(settings, 10, 1)
    assert (error.value.kind, error.value.key) == ("out_of_range", key)


def test_cosine_is_half_a_wave():
    lr = rates(schedule("Cosine"), 10, 10)
    assert lr == pytest.approx([0.5 * (1 + math.cos(math.pi * k / 10)) for k in range(10)])


def with_gradients(optimizer, network, steps):
    """Steps on a loss that moves every parameter."""
    for k in range(steps):
        optimizer.zero_grad()
        sum(((1 + k) * p - 1).square().sum() for p in network.parameters()).backward()
        optimizer.step()


def test_muon_takes_the_matrices_of_hidden_layers_and_adam_the_rest():
    torch.manual_seed(0)
    network = network_of(depth=2, linear_skip="linear")
    settings = {"_target_": MUON, "lr": 1e-3, "encoding_lr": 1e-2}
    optimizer = build_optimizer(network, settings)
    assert [group["name"] for group in optimizer.param_groups] == [
        "matrices",
        "network",
        "encoding",
    ]
    before = {key: p.detach().clone() for key, p in network.named_parameters()}
    with_gradients(optimizer, network, 1)
    moved = {key: (p - before[key]).detach() for key, p in network.named_parameters()}
    matrices = {f"blocks.{k}.{part}.weight" for k in (0, 1) for part in ("first", "second")}
    matrices.add("input.weight")
    assert matrices < set(moved)
    for key, move in moved.items():
        if key in matrices:  # 0.2 lr √max(A, B) times a matrix whose singular values are near 1
            step = torch.linalg.svdvals(move)[0] / (0.2e-3 * max(move.shape) ** 0.5)
            assert 0.6 < float(step) < 1.4
        else:  # Adam's first step has the rate's length in each entry
            rate = 1e-2 if ".tables." in key else 1e-3
            assert torch.allclose(move.abs(), torch.tensor(rate), rtol=1e-2)


def test_muon_goes_on_from_its_state_as_if_never_stopped(tmp_path):
    settings = {"_target_": MUON, "lr": 1e-2, "encoding_lr": 3e-2, "betas": [0.9, 0.99]}
    plan = schedule("Cosine", warmup=2)

    def start():
        torch.manual_seed(0)
        network = network_of()
        optimizer = build_optimizer(network, settings)
        return network, optimizer, build_scheduler(optimizer, plan, 20)

    def go_on(network, optimizer, scheduler, steps):
        for _ in range(steps):
            with_gradients(optimizer, network, 1)
            scheduler.step()

    whole, first, second = start(), start(), start()
    go_on(*whole, 10)
    go_on(*first, 5)
    torch.save([part.state_dict() for part in first], tmp_path / "state.pt")
    for part, state in zip(
        second, torch.load(tmp_path / "state.pt", weights_only=True), strict=True
    ):
        part.load_state_dict(state)
    go_on(*second, 5)
    for a, b in zip(whole[0].parameters(), second[0].parameters(), strict=True):
        assert torch.equal(a, b)


def test_muon_without_matrices_is_refused():
    with pytest.raises(NsmError) as error:
        build_optimizer(torch.nn.LayerNorm(3), {"_target_": MUON, "lr": 1e-3})
    assert error.value.key == "optimizer"


def test_lbfgs_solves_a_quadratic_with_grids_and_network_as_one():
    network = network_of()
    settings = {"_target_": "torch.optim.LBFGS", "max_iter": 50, "line_search_fn": "strong_wolfe"}
    optimizer = build_optimizer(network, settings)
    assert len(optimizer.param_groups) == 1

    def loss():
        optimizer.zero_grad()
        value = sum((p - 1).square().sum() for p in network.parameters())
        value.backward()
        return value

    optimizer.step(loss)
    assert all(torch.allclose(p, torch.ones_like(p), atol=1e-4) for p in network.parameters())


def assert_alike(state, other):
    assert state["param_groups"] == other["param_groups"]
    torch.testing.assert_close(state["state"], other["state"])


@pytest.mark.parametrize("name", ["Adam", "AdamW", "NAdam", "RMSprop", "SGD", "muon"])
@pytest.mark.parametrize("own_rates", [False, True])
def test_one_optimizer_makes_the_steps_of_several(name, own_rates):
    target = MUON if name == "muon" else f"torch.optim.{name}"
    settings = [{"_target_": target, "lr": 1e-2, "encoding_lr": 3e-2} for _ in range(3)]
    if name == "muon" and not hasattr(torch.optim, "Muon"):
        pytest.skip("torch is older than 2.9")
    if own_rates:
        settings[1]["lr"] = 2e-2
    common = [shared_options(one) for one in settings]
    if own_rates and name == "muon":  # whose matrices are one group
        assert common[0] != common[1]
        return
    assert common[0] == common[1] == common[2]
    networks = [network_of(depth=2, width=4) for _ in settings]
    copies = copy.deepcopy(networks)
    plan = schedule("Cosine", warmup=3)

    def scheduled(optimizer):
        return optimizer, build_scheduler(optimizer, plan, 10)

    alone = [scheduled(build_optimizer(*both)) for both in zip(networks, settings, strict=True)]
    each = [scheduled(build_optimizer(*both))[0] for both in zip(copies, settings, strict=True)]
    joint, rates = scheduled(in_one(each))
    assert len(joint.param_groups) == len(each[0].param_groups) * (3 if own_rates else 1)
    for _ in range(4):
        for network, copied in zip(networks, copies, strict=True):
            for p, q in zip(network.parameters(), copied.parameters(), strict=True):
                p.grad = torch.randn_like(p)
                q.grad = p.grad.clone()
        for optimizer, scheduler in [*alone, (joint, rates)]:
            optimizer.step()
            scheduler.step()
    for network, copied in zip(networks, copies, strict=True):
        for p, q in zip(network.parameters(), copied.parameters(), strict=True):
            torch.testing.assert_close(p, q)
    shares = Shares(joint, each)
    states = [shares.of_optimizer(joint.state_dict(), i) for i in range(3)]
    schedules = [shares.of_schedule(rates.state_dict(), i) for i in range(3)]
    for (optimizer, scheduler), state, of_schedule in zip(alone, states, schedules, strict=True):
        assert_alike(state, optimizer.state_dict())
        assert of_schedule == scheduler.state_dict()
    assert_alike(shares.optimizer(states), joint.state_dict())
    assert shares.schedule(schedules) == rates.state_dict()


def test_steps_that_depend_on_all_weights_are_made_alone():
    assert shared_options({"_target_": "torch.optim.LBFGS", "lr": 1.0}) is None
