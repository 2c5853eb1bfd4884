"""Trainings on an accelerator: here a pretended one (see tests/pretend_device.py)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from copy import deepcopy
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import pytorch_lightning as pl
import tiny
import torch
from pretend_device import NAME, Counts, OnDevice, pretended, trainer
from rich.console import Console
from torch import Tensor, nn

import nsm
from nsm.config import compose_config
from nsm.data import SurfaceSampler
from nsm.maps import SplineField, batched
from nsm.maps.at_points import AtPoints
from nsm.pipeline import built, make_task
from nsm.results import NeuralSurface
from nsm.tasks.device_level import DeviceLevel, _factor
from nsm.tasks.quasi_newton import QuasiNewton
from nsm.tasks.spline_level import Level

KINDS = [(False, False), (True, False), (True, True)]  # periodic, odd
NETWORK = ["encoding.resolutions=[4,8]", "map.width=8"]
PAPER = ["experiment=paper", "map.width=8", "map.depth=2"]
# two steps of Adam, then one quasi-Newton step
BOTH = [
    "map.cells=8",
    "trainer.max_steps=3",
    "optimizer.newton_from=0.6",
    "optimizer.iterations=2",
    "constraints.triangles_from=0.6",
]
LEVELS = ["map.cells=8", "optimizer.levels=[4,8]", "optimizer.steps=[1]", "optimizer.iterations=2"]


@pytest.fixture(scope="module")
def phis() -> list[NeuralSurface]:
    found = []
    for height, rings in ((0.2, 4), (0.4, 4), (0.6, 3)):
        surface = tiny.dome(height, rings)
        network = module("overfit", NETWORK, surface).map.eval().requires_grad_(False)
        found.append(NeuralSurface(surface, network))
    return found


def module(name: str, words: list[str], *inputs: Any) -> Any:
    """What a task trains."""
    task: Any = make_task(compose_config([f"task={name}", *words]), Console(quiet=True))
    task.use(*inputs)
    return built(task)


def training(task: str, words: list[str], phis: list[NeuralSurface]) -> Any:
    """The module of a task for neural surfaces, which it may move to a device."""
    phis = deepcopy(phis)
    marks = [np.array([0, 5])] * len(phis)
    given: dict[str, tuple[Any, ...]] = {
        "overfit": (phis[0].surface,),
        "param": (phis[0],),
        "pair_map": (*phis[:2], marks[:2]),
        "collection_map": (phis, marks),
    }
    made = module(task, words, *given[task])
    made.log_every = 10**9  # there is no logger
    return made


def stepped(
    trained: Any, surface: nsm.Surface, steps: int, counts: Counts | None = None
) -> tuple[Tensor, list[tuple[Counts, int]]]:
    """Make steps of a module where it is.

    Returns:
        The loss after them; and what the device did in each, with the number of evaluations of the
        loss.
    """
    device = next(trained.parameters()).device
    points = SurfaceSampler(surface)
    optimizer = trained.configure_optimizers()["optimizer"]
    loss: Any = None
    done = []
    for step in range(steps):
        trained._trainer = SimpleNamespace(global_step=step)
        samples = points.by_area(64, points.generator(0, step))
        batch: Any = type(samples)(*(part.to(device) for part in samples))
        batch = batch.uv if hasattr(trained, "phis") else batch
        evaluated = 0

        def closure(batch: Any = batch) -> Tensor:
            nonlocal evaluated
            evaluated += 1
            optimizer.zero_grad()
            value: Tensor = trained.training_step(batch, 0)
            value.backward()
            return value.detach()

        if counts is not None:
            counts.clear()
        loss = optimizer.step(closure)
        done.append((deepcopy(counts) or Counts(), evaluated))
    trained._trainer = None
    return loss, done


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("overfit", NETWORK),
        ("overfit", PAPER),
        ("param", LEVELS),
        ("param", PAPER),
        ("pair_map", BOTH),
        ("pair_map", PAPER),
        ("collection_map", PAPER),
    ],
    ids=lambda value: value if isinstance(value, str) else value[0],
)
def test_steps_on_a_device_are_those_on_the_cpu(task, words, phis):
    here = training(task, words, phis)
    loss, _ = stepped(here, phis[0].surface, 3)
    with pretended():
        there = training(task, words, phis).to(NAME)
        found, _ = stepped(there, phis[0].surface, 3)
        weights = [p for p in there.map.parameters() if p.requires_grad]
        assert weights and all(isinstance(p, OnDevice) for p in weights)
        torch.testing.assert_close(found.cpu(), loss, rtol=1e-4, atol=1e-6)
        x = torch.as_tensor(phis[0].surface.uv, dtype=torch.float32)
        torch.testing.assert_close(there(x.to(NAME)).cpu(), here(x), rtol=1e-4, atol=1e-4)


@contextmanager
def on_the_device() -> Any:
    """Whatever Lightning trains within the block, it trains on the pretend device."""
    kind = pl.Trainer
    with pretended() as counts, mock.patch.object(pl, "Trainer", lambda **k: trainer(kind, **k)):
        yield counts


def test_a_run_on_a_device_ends_as_on_the_cpu(phis):
    words = ["data.steps_per_epoch=2", "data.batch_size=64", "data.held_out=16", "logger=csv"]
    words += ["trainer.log_every=1", "trainer.threads=1", "artefacts=false", *BOTH]

    def run() -> dict[str, Any]:
        found = nsm.map_collection(phis, [[0, 5]] * 3, overrides=words, progress=False).metrics
        return found["pairs"]["dome 0.2 → dome 0.4"] | found  # type: ignore[no-any-return]

    expected = {k: v for k, v in run().items() if isinstance(v, float)}
    with on_the_device():
        found = run()
    assert "symmetric_dirichlet_median" in expected
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=2e-3, abs=1e-4), key


@pytest.mark.parametrize("task", ["pair_map", "collection_map"])
def test_a_step_waits_for_one_or_two_numbers(task, phis):
    with pretended() as counts:
        trained = training(task, BOTH, phis).to(NAME)
        _, done = stepped(trained, phis[0].surface, 3, counts)
    # the first step looks at all triangles; beside these, one of Adam has nothing from the host
    adam, _ = done[1]
    assert adam.launched.total() > 100
    assert not adam.to_device and not adam.to_host and not adam.waits
    newton, evaluations = done[-1]
    # the loss of each evaluation; of each of two iterations the slope, and whether the pair is
    # kept; whether each component's matrix, of three, has a factor
    turns = 1 if task == "pair_map" else 3
    numbers = [n for n in newton.to_host if n == 1]
    assert evaluations <= len(numbers) <= evaluations + turns * (2 * 2 + 3)
    if task == "pair_map":  # those of a collection are inverted in turn, by the host
        assert numbers == newton.to_host
        assert len(newton.to_device) <= 8  # what the level is made of


def problem(device: str) -> tuple[SplineField, QuasiNewton, Callable[[], Tensor]]:
    """A spline that should become a wave, on coarse levels first."""
    field = SplineField(2, 16).to(device)
    x = 2 * torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) - 1
    x, wanted = x.to(device), (3 * x.flip(1)).sin().to(device)
    steps = {"iterations": 4, "smoothing": 1e-3}
    optimizer = QuasiNewton([field.coefficients], [field], [4, 8, 16], [1, 1], **steps)  # type: ignore[arg-type]

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = ((field(x) - wanted) ** 2).sum(dim=1).mean()
        loss.backward()
        return loss.detach()

    return field, optimizer, closure


def test_levels_lead_to_the_same_spline_on_a_device():
    here, optimizer, closure = problem("cpu")
    for _ in range(3):
        optimizer.step(closure)
    with pretended():
        there, optimizer, closure = problem(NAME)
        for _ in range(3):
            optimizer.step(closure)
        torch.testing.assert_close(
            there.coefficients.cpu(), here.coefficients, rtol=1e-3, atol=1e-4
        )


@pytest.mark.parametrize("cells", [8, 32])  # the level itself, and a finer one
@pytest.mark.parametrize("periodic, odd", KINDS)
def test_a_level_on_a_device_has_the_matrices_of_one_on_the_cpu(periodic, odd, cells):
    field = SplineField(2, cells, periodic, odd)
    nn.init.normal_(field.coefficients)
    here = Level(field, 8)
    there = DeviceLevel(here, torch.device("cpu"))
    c, g = torch.randn(here.rows, 2).double(), torch.randn(len(field.coefficients), 2).double()
    for matrix, x in (("up", c), ("down", g), ("smoothness", c)):
        expected = getattr(here, matrix) @ x.numpy()
        np.testing.assert_allclose((getattr(there, matrix) @ x).numpy(), expected, atol=1e-12)
    assert np.array_equal(
        there.restored(field.coefficients).numpy(), here.restored(field.coefficients)
    )
    half = torch.randn(2, 100, 3, 3).double()
    seen = [(2 * torch.rand(100, 2) - 1, half @ half.mT)]
    expected, entries = here.entries(0.1, seen), there.entries(0.1, seen)
    np.testing.assert_allclose(entries.numpy(), expected, rtol=1e-9, atol=1e-12)
    solved = here.metric(expected).solve(c.numpy())
    np.testing.assert_allclose(there.metric(entries).solve(c).numpy(), solved, rtol=1e-9)


def test_a_matrix_that_is_not_positive_definite_has_a_factor():
    nearly = torch.ones(3, 3).double()
    factor = _factor(nearly.clone())
    torch.testing.assert_close(factor @ factor.T, nearly, rtol=1e-2, atol=1e-2)
    factor = _factor(torch.tensor([[4.0, 9.0], [9.0, -1.0]]).double())
    torch.testing.assert_close(factor, torch.tensor([[2.0, 0.0], [0.0, 1.0]]).double())


@pytest.mark.parametrize("periodic, odd", KINDS)
def test_splines_on_a_device_are_read_in_one_batch(periodic, odd):
    splines: list[Any] = [SplineField(2, 8, periodic, odd) for _ in range(3)]
    for spline in splines:
        nn.init.normal_(spline.coefficients)
    x = 2 * torch.rand(3, 50, 2) - 1

    def all_of() -> list[Tensor]:
        place = splines[0].coefficients.device
        value, jacobian = batched(splines).value_and_jacobian(x.to(place))
        by = [s.coefficients for s in splines]
        gradients = torch.autograd.grad(value.sum() + jacobian.square().sum(), by)
        return [
            t.detach().cpu() for t in (value, jacobian, batched(splines)(x.to(place)), *gradients)
        ]

    expected = all_of()
    with pretended() as counts:
        splines = [s.to(NAME) for s in splines]
        counts.clear()
        found = all_of()
        assert counts.launched["index_select"] == 2  # of all three
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_what_is_known_at_points_on_a_device_is_found_without_a_look_at_them():
    known, made = AtPoints(1000), []

    def compute() -> int:
        made.append(0)
        return len(made)

    with pretended() as counts:
        x, same = torch.zeros(4, 2, device=NAME), torch.zeros(4, 2, device=NAME)
        assert [known.get(x, compute), known.get(x, compute), known.get(same, compute)] == [1, 1, 2]
        x.add_(1)
        assert known.get(x, compute) == 3
        assert not counts.to_host and not counts.waits


REFUSED: dict[str, Callable[[Tensor, Tensor], Any]] = {
    "a sum": lambda x, y: x + y,
    "a product of matrices": lambda x, y: x @ y.T,
    "a concatenation": lambda x, y: torch.cat([x, y]),
    "a change of the CPU's": lambda x, y: y.add_(x),
    "a scalar of the CPU that is changed": lambda x, y: y[0, 0].add_(x[0, 0]),
    "a scalar where none is taken": lambda x, y: torch.stack([x[0, 0], y[0, 0]]),
    "an index there": lambda x, y: y[x.long()],
    "a row of an index on the CPU": lambda x, y: x.index_select(0, y[0].long()),
    "numpy": lambda x, y: x.numpy(),
    "an array": lambda x, y: np.asarray(x),
}


@pytest.mark.parametrize("what", REFUSED)
def test_the_pretend_device_refuses_what_cuda_refuses(what):
    with pretended():
        x, y = torch.ones(3, 2, device=NAME), torch.ones(3, 2)
        with pytest.raises((RuntimeError, TypeError)):
            REFUSED[what](x, y)


def test_the_pretend_device_has_no_transforms():
    with pretended(), pytest.raises(NotImplementedError, match="torch.func"):
        torch.func.jvp(lambda x: x.sin(), (torch.ones(2),), (torch.ones(2),))


def test_the_pretend_device_takes_what_cuda_takes_and_counts():
    with pretended() as counts:
        x = torch.arange(6.0, device=NAME).reshape(3, 2)
        assert not counts.to_device and not counts.to_host
        torch.testing.assert_close((2 * x + torch.tensor(1.0)).cpu()[2], torch.tensor([9.0, 11.0]))
        assert counts.to_host == [6]
        assert float(x.sum()) == 15.0 and x[0].tolist() == [0.0, 1.0]
        assert counts.to_host == [6, 1, 2]
        assert x[torch.tensor([2])].shape == (1, 2) and counts.to_device == [1]
        assert torch.tensor([1.0], device=NAME).device == x.device and counts.to_device == [1, 1]
        assert not counts.waits
        assert len(x[x > 2]) == 3 and counts.waits.total() == 1
        weight = nn.Parameter(x.clone())
        ((weight + 1) ** 2).sum().backward()
        torch.testing.assert_close(weight.grad, 2 * (x + 1))
