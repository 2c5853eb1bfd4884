"""The candidates of the benchmarks compute what their docstrings say."""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf
from pytorch_lightning.callbacks import Callback

import nsm
from nsm.config import compose_config
from nsm.data import SurfaceSampler
from nsm.maps.networks import build_network
from nsm.tasks import Overfit

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
import candidates  # noqa: E402
import newton_steps  # noqa: E402
import steps  # noqa: E402
from training import train  # noqa: E402

GRID = {"_target_": "nsm.maps.encodings.SplineGrid", "resolutions": [4, 8], "features": 3}
MAP = {"_target_": "nsm.maps.NeuralMap", "width": 8, "depth": 1, "block": "plain"}
NETWORK = {
    "map": MAP,
    "activation": {"_target_": "nsm.maps.activations.Softplus", "beta": 10.0},
    "encoding": GRID,
}
SETTINGS = {
    **NETWORK,
    "optimizer": {"_target_": "torch.optim.Adam", "lr": 1e-3, "encoding_lr": 1e-2},
    "scheduler": {"_target_": "nsm.tasks.schedules.Constant"},
    "loss_weights": {"normal": 0.01},
    "max_steps": 10,
    "diagonal": 1.0,
}


@pytest.fixture(scope="module")
def surface():
    return nsm.Surface.load("hemisphere")


def batch_of(surface, count, dtype=torch.float64):
    sampler = SurfaceSampler(surface)
    samples = sampler.by_area(count, sampler.generator(0))
    return type(samples)(*(part.to(dtype) for part in samples))


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = build_network(**{**NETWORK, "map": {**MAP, "linear_skip": "linear"}}, out_dim=3)
    network = network.double()
    torch.nn.init.normal_(network.linear_skip.weight)
    return network


def test_the_squared_residuals_are_the_loss(network, surface):
    batch = batch_of(surface, 50)
    module = Overfit(**SETTINGS)
    module.map, module.log_every = network, 2  # nothing is logged
    loss = module.training_step(batch, 0)
    residual = candidates.residuals(network, batch, 0.01)
    torch.testing.assert_close(residual.square().sum(), loss)
    found = torch.autograd.grad(residual.square().sum(), list(network.parameters()))
    wanted = torch.autograd.grad(loss, list(network.parameters()))
    torch.testing.assert_close(found, wanted)


def test_products_are_those_of_the_jacobian(network, surface):
    batch = batch_of(surface, 6)
    parameters = list(network.parameters())
    residual = candidates.residuals(network, batch, 0.01)
    products = candidates.Products(residual, parameters)
    rows = [torch.autograd.grad(entry, parameters, retain_graph=True) for entry in residual]
    jacobian = torch.stack([torch.cat([part.flatten() for part in row]) for row in rows])
    v, u = torch.randn(jacobian.shape[1]).double(), torch.randn(len(residual)).double()
    torch.testing.assert_close(products.jvp(v), jacobian @ v)
    torch.testing.assert_close(products.vjp(u), jacobian.T @ u)
    # J v once more, by differences
    step = 1e-6 * v
    moved = []
    for sign in (1, -1):
        for p, part in zip(parameters, step.split([p.numel() for p in parameters]), strict=True):
            p.data += sign * part.view_as(p)
        moved.append(candidates.residuals(network, batch, 0.01).detach())
        for p, part in zip(parameters, step.split([p.numel() for p in parameters]), strict=True):
            p.data -= sign * part.view_as(p)
    torch.testing.assert_close((moved[0] - moved[1]) / 2e-6, products.jvp(v), rtol=1e-5, atol=1e-6)


def test_a_damped_step_solves_its_system():
    generator = torch.Generator().manual_seed(0)
    design = torch.randn(30, 5, generator=generator).double()
    wanted = torch.randn(30, generator=generator).double()
    p, q = (torch.zeros(k, dtype=torch.float64, requires_grad=True) for k in (3, 2))

    def residual():
        return design @ torch.cat([p, q]) - wanted

    def closure():
        return residual().square().sum()

    torch.manual_seed(0)
    optimizer = candidates.LevenbergMarquardt(
        [p, q], residual, lr=1.0, iterations=5, damping=0.5, probes=3000
    )
    before = float(closure().detach())
    optimizer.step(closure)
    squares = design.square().sum(dim=0)
    held = torch.cat([squares[:3].mean().expand(3), squares[3:].mean().expand(2)])
    solved = torch.linalg.solve(design.T @ design + 0.5 * torch.diag(held), design.T @ wanted)
    # the diagonal is known to a few percent
    torch.testing.assert_close(torch.cat([p, q]).detach(), solved, rtol=0.05, atol=0.01)
    # the residual is linear: the prediction is exact, and the damping stays at its least
    assert float(closure().detach()) < before and optimizer.damping == 0.5


def test_weights_restore_the_mean_by_area(surface):
    sampler = candidates.ErrorSampler(surface)
    centres = surface.vertices[surface.faces].mean(axis=1)
    sampler.error = torch.as_tensor(np.exp(3 * centres[:, 2]))
    drawn = sampler.weighted(200_000, sampler.generator(3))
    height = drawn.points[:, 2]
    area = sampler.area.numpy()
    wanted = float(area @ centres[:, 2])
    spread = float((height * drawn.weight).std()) / 200_000**0.5
    assert abs(float((height * drawn.weight).mean()) - wanted) < 4 * spread
    assert float(height.mean()) > wanted + 10 * spread


def test_triangles_with_larger_errors_are_sampled_more(surface):
    sampler = candidates.ErrorSampler(surface)
    face, weight = torch.tensor([7, 8]), torch.ones(2)
    for _ in range(20):
        sampler.seen(face, torch.tensor([3.0, 1.0]), weight)
    torch.testing.assert_close(
        sampler.error[:9], torch.tensor([1.0] * 7 + [1.5, 0.5]).double(), rtol=1e-2, atol=0
    )


@pytest.mark.parametrize("log2_rows", [6, 12])
def test_a_hash_grids_jacobian_is_its_derivative(log2_rows):
    torch.manual_seed(0)
    grid = candidates.HashGrid(2, levels=3, coarsest=4, finest=16, log2_rows=log2_rows).double()
    torch.nn.init.normal_(grid.tables[0])
    x = torch.rand(200, 2).double() * 1.8 - 0.9
    stack = grid.value_and_jacobian_stack(x)
    for axis in range(2):
        step = 1e-7 * torch.eye(2).double()[axis]
        moved = (grid(x + step) - grid(x - step)) / 2e-7
        torch.testing.assert_close(stack[1 + axis], moved, rtol=1e-5, atol=1e-5)
    assert max(grid.rows) == min(2**log2_rows, 17**2)


def test_levels_are_released_in_turn():
    module = candidates.CoarseToFine(**SETTINGS)
    module.progress = lambda: 0.0
    module.on_fit_start()
    coarse, fine = module.map.encoding.tables
    assert coarse.any() and not fine.any()
    for spent, released in ((0.0, False), (0.39, False), (0.41, True)):
        module.progress = partial(float, spent)
        module.on_train_batch_start(None, 0)
        assert coarse.requires_grad and fine.requires_grad == released


@pytest.mark.parametrize("kind", ["soap", "shampoo"])
def test_only_matrices_are_preconditioned(kind):
    pytest.importorskip("pytorch_optimizer")
    torch.manual_seed(0)
    muon = compose_config(["optimizer=muon", "optimizer.lr=1e-2", "optimizer.encoding_lr=1e-2"])
    settings = {**SETTINGS, "optimizer": OmegaConf.to_container(muon.optimizer)}
    module = candidates.Preconditioned(kind=kind, every=2, **settings)
    optimizer = module.optimizer()
    names = {id(p): name for name, p in module.map.named_parameters()}
    matrices, *others = ([names[id(p)] for p in g["params"]] for g in optimizer.param_groups)
    assert matrices == ["input.weight", "blocks.0.linear.weight"]
    assert sorted(matrices + sum(others, [])) == sorted(names.values())
    x = torch.rand(64, 2)

    def loss():
        return (module.map(x) - torch.cat([x, x[:, :1] ** 2], 1)).square().mean()

    before = float(loss().detach())
    for _ in range(60):
        optimizer.zero_grad()
        loss().backward()
        optimizer.step()
    assert float(loss().detach()) < 0.1 * before


@pytest.mark.parametrize(
    "settings",
    [
        ["candidate=gauss_newton", "optimizer.lr=1", "candidate.iterations=2"],
        [
            "candidate=gauss_newton",
            "optimizer.lr=1",
            "map.linear_skip=fitted",
            "candidate.damping=1",
        ],
        ["optimizer=muon", "candidate=preconditioned", "candidate.kind=soap"],
        ["candidate=by_error"],
        ["candidate=growing_batch", "candidate.first=64", "candidate.last=256"],
        ["candidate=coarse_to_fine"],
        ["encoding=hash_grid"],
    ],
    ids=lambda settings: settings[-1],
)
def test_a_candidate_trains(settings, surface, request):
    if "candidate.kind=soap" in settings:
        pytest.importorskip("pytorch_optimizer")
    if "encoding=hash_grid" in settings:
        candidates.register()
        # other tests look at the options of the group
        options = ConfigStore.instance().repo["encoding"]
        request.addfinalizer(lambda: options.pop("hash_grid.yaml"))
    of_nsm, own = candidates.parted(steps.in_full(settings))
    small = [] if "encoding=hash_grid" in settings else ["encoding.resolutions=[4,16]"]
    config = compose_config([*of_nsm, *small, "data.batch_size=64", "trainer.max_steps=8"])
    sizes, losses = [], []

    class Watch(Callback):
        def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
            sizes.append(len(batch.uv))
            losses.append(float(outputs["loss"]))

    def piece(module):
        return candidates.exchanged(module, own, lambda: min(1.0, len(sizes) / 6))

    trainer, module, _ = train(config, surface, [Watch()], exchanged=piece)
    assert trainer.global_step == 8 and losses[-1] < losses[0]
    assert module.map.output.weight.any()  # zero at first where it is fitted
    assert isinstance(module, candidates.Candidate) == bool(own)
    if "candidate=growing_batch" in settings:
        assert sizes[0] == 64 and sizes[-1] == 256 and sizes == sorted(sizes)
    else:
        assert set(sizes) == {64}


def test_slims_proxies_have_the_gradient_of_the_energy():
    generator = torch.Generator().manual_seed(0)
    phi, psi, h = torch.randn(3, 30, 2, 2, generator=generator).double()
    source, target = phi.mT @ phi, psi.mT @ psi
    hessians = newton_steps.proxies(source, target, h)
    assert (torch.linalg.eigvalsh(hessians) > 0).all()
    at = h.clone().requires_grad_()
    energy = nsm.energies.symmetric_dirichlet(source, at.mT @ target @ at)
    gradient = torch.autograd.grad(energy.sum(), at)[0].flatten(1)
    # the proxy's minimum: the singular values of psi h phi^-1 are those of the least energy
    u, _, v = torch.linalg.svd(psi @ h @ torch.linalg.inv(phi))
    least = 0.99**0.5 * torch.linalg.inv(psi) @ u @ v @ phi
    found = (hessians @ (h - least).flatten(1)[..., None])[..., 0]
    torch.testing.assert_close(found, gradient, rtol=1e-4, atol=1e-5)
