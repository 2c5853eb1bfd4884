"""Maps in one batch do what each of them does alone."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from map_samples import activation, encoding, network, planar
from torch import Tensor

from nsm.maps import Composition, Rotated, batched, build_analytic
from nsm.maps.batched_maps import BatchedNetworks, OneByOne

GRID = encoding("SplineGrid", resolutions=[4, 16], features=3)
NETWORKS: list[dict[str, Any]] = [
    {"depth": 2, "block": "plain", "enc": GRID},
    {"depth": 2, "block": "post", "enc": {**GRID, "degree": 3}},
    {"depth": 3, "block": "pre", "enc": encoding("RandomFourierFeatures", features=8)},
    {"depth": 2, "block": "post", "act": activation("SiLU")},
    {"depth": 1, "block": "plain", "enc": GRID, "linear_skip": "linear"},
]


def several(settings: dict[str, Any], count: int = 3) -> list[torch.nn.Module]:
    torch.manual_seed(0)
    maps = [network(width=16, **settings) for _ in range(count)]
    for one in maps:  # no layer that is zero at the start
        for parameter in one.parameters():
            torch.nn.init.normal_(parameter, std=0.3)
    return list(maps)


def answers(one: Any, x: Tensor) -> tuple[Tensor, ...]:
    value, jacobian = one.value_and_jacobian(x)
    return value, jacobian, one(x)


def each_alone(maps: list[Any], x: Tensor) -> tuple[Tensor, ...]:
    parts = [answers(m, points) for m, points in zip(maps, x, strict=True)]
    return tuple(torch.stack(same) for same in zip(*parts, strict=True))


def gradients(results: tuple[Tensor, ...], by: list[Tensor]) -> tuple[Tensor, ...]:
    torch.manual_seed(1)
    total = sum((torch.randn(r.shape, dtype=r.dtype) * r).sum() for r in results)
    return torch.autograd.grad(total, by)  # type: ignore[arg-type]


def check(maps: list[Any], count: int = 37) -> None:
    x = (torch.rand(len(maps), count, 2, dtype=torch.float64) - 0.5).requires_grad_()
    parameters = [p for m in maps for p in m.parameters()]
    batch, alone = answers(batched(maps), x), each_alone(maps, x)
    for a, b in zip(batch, alone, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    got, wanted = (gradients(r, [x, *parameters]) for r in (batch, alone))
    for a, b in zip(got, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("settings", NETWORKS)
def test_networks(settings):
    maps = several(settings)
    assert isinstance(batched(maps), BatchedNetworks)
    check(maps)


def test_so_many_points_that_they_are_taken_in_parts():
    check(several(NETWORKS[0]), count=3000)


@pytest.mark.parametrize("onto", [None, "disc", "square"])
def test_planar_maps_rotated_each_its_own_way(onto):
    torch.manual_seed(0)
    maps = []
    for angle in torch.tensor([0.0, 0.4, -2.0], dtype=torch.float64):
        h = planar(onto, enc=GRID, width=8, depth=1)
        torch.nn.init.normal_(h.network.output.weight, std=0.1)
        c, s = angle.cos(), angle.sin()
        maps.append(Rotated(h, torch.stack([torch.stack([c, -s]), torch.stack([s, c])])))
    assert not isinstance(batched(maps).inner, OneByOne)
    check(maps)


def test_frozen_networks_pass_gradients_on_and_take_none():
    maps = several(NETWORKS[0])
    for one in maps:
        one.requires_grad_(False)
    x = torch.rand(3, 9, 2, dtype=torch.float64, requires_grad=True)
    results = batched(maps).value_and_jacobian(x)
    (gradient,) = gradients(results, [x])
    (wanted,) = gradients(each_alone(maps, x)[:2], [x])
    torch.testing.assert_close(gradient, wanted)
    assert all(p.grad is None for m in maps for p in m.parameters())


def test_maps_that_are_not_alike_are_evaluated_all_the_same():
    networks = several(NETWORKS[0], 1) + several(NETWORKS[1], 1)
    cone = build_analytic({"name": "cone"}).double()
    for maps in (
        networks,
        [networks[0], cone],
        [Composition(cone, m) for m in [planar(width=4, depth=1)] * 2],
    ):
        assert isinstance(batched(maps), OneByOne)
        x = torch.rand(2, 9, 2, dtype=torch.float64) * 0.5
        for a, b in zip(answers(batched(maps), x), each_alone(maps, x), strict=True):
            torch.testing.assert_close(a, b)
