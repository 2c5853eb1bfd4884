"""Alternatives that trials of steps.py compare with parts of nsm; none is a setting of nsm.

Each candidate is the task of overfitting with one part replaced. A trial selects it with
``candidate=NAME`` and ``candidate.SETTING=VALUE``; the encoding is an option of the group
``encoding``, as users' own encodings are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf
from scipy.sparse import csr_matrix
from torch import Tensor, nn
from torch.optim import Optimizer

from nsm.data import Samples, SurfaceData, SurfaceSampler
from nsm.domains import Surface
from nsm.energies.overfit import NORMAL_FLOOR, normal, position
from nsm.maps import NeuralMap, SplineGrid
from nsm.maps.encodings import value_and_jacobian_stack
from nsm.tasks import Overfit
from nsm.tasks.optimizers import MuonBesideAdam, build_optimizer
from nsm.tasks.schedules import scheduled


class Candidate(Overfit):
    """Overfitting with one part replaced.

    Attributes:
        samples: the data module that draws its samples.
        progress: the share of the budget that has been spent, in [0, 1].
    """

    samples: type[SurfaceData] = SurfaceData
    progress: Callable[[], float]

    def optimizer(self) -> Optimizer:
        """The optimizer that replaces nsm's."""
        return build_optimizer(self.map, dict(self.hparams["optimizer"]))

    def configure_optimizers(self) -> Any:
        return scheduled(self.optimizer(), self.hparams)


# Second order: damped Gauss–Newton steps


class _Times(torch.autograd.Function):
    """The product A X of a sparse matrix A (r, c) and X (c, m), differentiable at any order."""

    @staticmethod
    def forward(ctx: Any, matrix: csr_matrix, x: Tensor) -> Tensor:
        ctx.matrix = matrix
        return torch.from_numpy(matrix @ x.numpy())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor]:  # type: ignore[override]
        return None, _Times.apply(ctx.matrix.T, gradient)


def _features(encoding: Any, uv: Tensor) -> Tensor:
    """Value and both tangents (3, N, out_dim) of features; the tables of a grid are parameters."""
    if not isinstance(encoding, SplineGrid):
        return value_and_jacobian_stack(encoding, uv).detach()
    parts = [torch.cat([uv[None], torch.eye(2).to(uv)[:, None].expand(-1, len(uv), -1)])]
    for level, table in enumerate(encoding.tables):
        rows, weights = encoding.seen(uv, level)
        taps = rows.shape[1]
        each = np.arange(0, 3 * len(uv) * taps + 1, taps)
        seen = rows.repeat(3, 1).flatten().numpy()
        matrix = csr_matrix((weights.flatten().numpy(), seen, each), (3 * len(uv), len(table)))
        parts.append(_Times.apply(matrix, table).view(3, len(uv), -1))
    return torch.cat(parts, dim=-1)


def residuals(network: NeuralMap, batch: Samples, normal_weight: float) -> Tensor:
    """Residuals r (6 N,) on a batch: ‖r‖² is the loss of Eq. 1, twice differentiable.

    Args:
        network: φ, with plain blocks.
        batch: N samples.
        normal_weight: λ_n.
    """
    # a bias is added to values only; slices would be padded with zeros in the backward pass
    first = torch.tensor([1.0, 0.0, 0.0]).to(batch.uv)[:, None, None]

    def linear(layer: nn.Linear, x: Tensor) -> Tensor:
        return x @ layer.weight.T + first * layer.bias

    stack = features = _features(network.encoding, batch.uv)
    act = network.activation
    for layer in network.layers[:-1]:
        value, by_u, by_v = linear(layer, stack).unbind()
        value, slope = act.value_and_slope(value)
        stack = torch.stack([value, by_u * slope, by_v * slope])
    stack = linear(network.output, stack)
    if network.linear_skip is not None:
        stack = stack + linear(network.linear_skip, features)
    value, by_u, by_v = stack.unbind()
    cross = torch.linalg.cross(by_u, by_v)
    turned = cross / (cross.square().sum(dim=1, keepdim=True) + NORMAL_FLOOR).sqrt()
    parts = [value - batch.points, math.sqrt(normal_weight) * (turned - batch.normals)]
    return torch.cat([part.flatten() for part in parts]) / math.sqrt(len(batch.uv))


class Products:
    """J v and Jᵀ u without the Jacobian J (M, P) of residuals r (M,) by P parameters.

    Jᵀ u is a backward pass; J v is a backward pass through that one, which is linear in u.

    Args:
        residual: (M,), with its graph, twice differentiable.
        parameters: in the order of their entries in vectors v.
    """

    def __init__(self, residual: Tensor, parameters: Sequence[Tensor]) -> None:
        self.residual, self.parameters = residual, list(parameters)
        self.dual = torch.zeros_like(residual, requires_grad=True)
        self.vjp_of_dual = torch.autograd.grad(
            residual, self.parameters, self.dual, create_graph=True
        )

    def jvp(self, v: Tensor) -> Tensor:
        """J v (M,) of v (P,)."""
        parts = v.split([p.numel() for p in self.parameters])
        shaped = [part.view_as(p) for part, p in zip(parts, self.parameters, strict=True)]
        return torch.autograd.grad(self.vjp_of_dual, self.dual, shaped, retain_graph=True)[0]

    def vjp(self, u: Tensor) -> Tensor:
        """Jᵀ u (P,) of u (M,)."""
        parts = torch.autograd.grad(self.residual, self.parameters, u, retain_graph=True)
        return torch.cat([part.flatten() for part in parts])


class LevenbergMarquardt(Optimizer):
    """Steps lr · x, where conjugate gradients solve (JᵀJ + μ D) x = −Jᵀ r.

    D is constant on each tensor of parameters, the mean of the diagonal of JᵀJ there, so that
    entries that hardly affect the batch stay where they are. The diagonal is the preconditioner
    too, and is estimated as E[(Jᵀu)²] with random signs u. μ follows the ratio of the actual
    decrease to that predicted by the linear model, both on the batch of the step; a step that
    increases the loss there is undone.

    Args:
        parameters: as torch's optimizers take them.
        residual: computes r for the current parameters, on the batch of the last closure.
        lr: factor of the step.
        iterations: of conjugate gradients.
        damping: initial and least μ.
        probes: number of vectors u in a step.
    """

    def __init__(
        self,
        parameters: Any,
        residual: Callable[[], Tensor],
        lr: float,
        iterations: int,
        damping: float,
        probes: int,
    ) -> None:
        super().__init__(parameters, {"lr": lr})
        self.residual, self.iterations, self.probes = residual, iterations, probes
        self.damping = self.least = damping

    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        assert closure is not None
        with torch.enable_grad():
            value = closure()
            (group,) = self.param_groups
            products = Products(self.residual(), group["params"])
        residual = products.residual.detach()
        diagonal = torch.zeros(())
        for _ in range(self.probes):
            sign = torch.randint(0, 2, residual.shape).to(residual).mul_(2).sub_(1)
            diagonal = diagonal + products.vjp(sign).square() / self.probes
        # weights before an output layer that is still zero do not affect the loss yet
        diagonal = diagonal + 1e-6 * diagonal.mean()
        sizes = [p.numel() for p in group["params"]]
        means = [part.mean().expand(len(part)) for part in diagonal.split(sizes)]
        held = self.damping * torch.cat(means)
        x, predicted = self._solved(products, -products.vjp(residual), diagonal, held)
        before = float(residual.square().sum())
        with torch.no_grad():
            start = [p.clone() for p in group["params"]]
            parts = x.split([p.numel() for p in start])
            for p, part in zip(group["params"], parts, strict=True):
                p.add_(part.view_as(p))
            decrease = before - float(self.residual().square().sum())
            for p, old in zip(group["params"], start, strict=True):
                p.copy_(torch.lerp(old, p, group["lr"]) if decrease > 0 else old)
        if decrease < 0.25 * predicted:
            self.damping *= 4
        elif decrease > 0.75 * predicted:
            self.damping = max(self.damping / 3, self.least)
        return value

    def _solved(
        self, products: Products, right: Tensor, diagonal: Tensor, held: Tensor
    ) -> tuple[Tensor, float]:
        """x with (JᵀJ + held) x = right, and the decrease of the loss that the linear model
        predicts."""
        scale = 1 / (diagonal + held)
        x, left = torch.zeros_like(right), right.clone()
        guess = scale * left
        direction, product = guess.clone(), left @ guess
        for _ in range(self.iterations):
            image = products.vjp(products.jvp(direction)) + held * direction
            length = product / (direction @ image)
            x += length * direction
            left -= length * image
            guess = scale * left
            before, product = product, left @ guess
            direction = guess + product / before * direction
        return x, float(x @ right + x @ left + x @ (held * x))


class GaussNewton(Candidate):
    """Steps of :class:`LevenbergMarquardt` on the loss of Eq. 1, for all parameters."""

    def __init__(
        self, iterations: int = 10, damping: float = 0.1, probes: int = 3, **task: Any
    ) -> None:
        super().__init__(**task)
        self.inner = {"iterations": iterations, "damping": damping, "probes": probes}

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        self.batch = batch
        return super().training_step(batch, batch_idx)

    def optimizer(self) -> Optimizer:
        lr = self.hparams["optimizer"]["lr"]
        return LevenbergMarquardt(
            self.map.parameters(),
            lambda: residuals(self.map, self.batch, self.loss_weights.normal),
            lr=lr,
            **self.inner,
        )


# Optimizers of matrices that replace Muon beside Adam


class Beside(MuonBesideAdam):
    """Another optimizer for the matrices, with Adam for all other parameters.

    Args:
        muon: the optimizer whose groups and Adam are used.
        make: from the group of the matrices to their optimizer.
    """

    def __init__(
        self, muon: MuonBesideAdam, make: Callable[[list[dict[str, Any]]], Optimizer]
    ) -> None:
        matrices, *others = muon.param_groups
        other = make([{key: matrices[key] for key in ("params", "name", "lr")}])
        self._parts = (other, muon._parts[1])
        Optimizer.__init__(self, other.param_groups + others, {})
        self._share()


class Preconditioned(Candidate):
    """SOAP or Shampoo for the matrices of the hidden layers; Adam for grids, biases and the output.

    A table of a grid has up to 264,196 rows, too many for a preconditioner.
    """

    def __init__(self, kind: str = "soap", every: int = 10, **task: Any) -> None:
        super().__init__(**task)
        self.kind, self.every = kind, every

    def optimizer(self) -> Optimizer:
        import pytorch_optimizer

        settings = dict(self.hparams["optimizer"])
        muon = build_optimizer(self.map, settings)
        assert isinstance(muon, MuonBesideAdam)

        def make(groups: list[dict[str, Any]]) -> Optimizer:
            if self.kind == "soap":
                return pytorch_optimizer.SOAP(
                    groups,
                    lr=settings["lr"],
                    betas=(0.95, 0.95),
                    weight_decay=0.0,
                    precondition_frequency=self.every,
                )
            return pytorch_optimizer.ScalableShampoo(
                groups,
                lr=settings["lr"],
                betas=muon.param_groups[1]["betas"],
                start_preconditioning_step=self.every,
                preconditioning_compute_steps=self.every,
                graft_type=4,  # the step length of RMSProp
            )

        return Beside(muon, make)


# Samples


class Weighted(NamedTuple):
    """:class:`nsm.data.Samples` with their faces (N,) and the weights (N,) of their errors."""

    uv: Tensor
    points: Tensor
    normals: Tensor
    face: Tensor
    weight: Tensor


class ErrorSampler(SurfaceSampler):
    """Draws points with density 1 − share + share · e/ē by area, where e is a running error of each
    triangle and ē its mean by area.

    Args:
        surface: the prepared surface.
        share: of the points that are drawn by error, in [0, 1).
        decay: weight of a new error; the previous one has 1 − decay.
    """

    def __init__(self, surface: Surface, share: float = 0.5, decay: float = 0.3) -> None:
        super().__init__(surface)
        self.share, self.decay = share, decay
        self.area = torch.diff(self.cumulative_area, prepend=torch.zeros(1))
        self.error = torch.ones(len(self.faces), dtype=torch.float64)  # relative to the mean

    def weighted(self, count: int, generator: torch.Generator) -> Weighted:
        """``count`` points, with the weights that make their mean the mean by area."""
        more = 1 - self.share + self.share * self.error / (self.area @ self.error)
        face, places = self._places(count, generator, (self.area * more).cumsum(0))
        return Weighted(*self._at(face, places), face, (1 / more[face]).float())

    def seen(self, face: Tensor, error: Tensor, weight: Tensor) -> None:
        """Update the running errors by those of samples, (N,), with weights (N,)."""
        relative = (error / (error * weight).mean()).double()
        self.error[face] = torch.lerp(self.error[face], relative, self.decay)


class ByError(Candidate):
    """Half of the samples drawn by current error, the rest by area, without vertices.

    Args:
        weighted: weight the errors so that their mean is that by area.
    """

    class samples(SurfaceData):  # noqa: N801
        def setup(self, stage: str | None = None) -> None:
            super().setup(stage)
            self.points = ErrorSampler(self.surface)

        def batch(self, step: int) -> Any:
            assert isinstance(self.points, ErrorSampler)
            generator = self.points.generator(self.seed, step)
            return self.points.weighted(self.batch_size, generator)

    def __init__(self, weighted: bool = True, **task: Any) -> None:
        super().__init__(**task)
        self.weighted = weighted

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        value, jacobian = self.map.value_and_jacobian(batch.uv)
        squared = position(value, batch.points)
        squared = squared + self.loss_weights.normal * normal(jacobian, batch.normals)
        sampler = self.trainer.datamodule.points  # type: ignore[attr-defined]
        sampler.seen(batch.face, squared.detach().sqrt(), batch.weight)
        return (squared * batch.weight if self.weighted else squared).mean()


class GrowingBatch(Candidate):
    """Batches that grow by a constant factor over the training.

    Args:
        first, last: sizes of the first and the last batch.
    """

    def __init__(self, first: int = 256, last: int = 8192, **task: Any) -> None:
        super().__init__(**task)
        self.first, self.last = first, last

    def on_train_batch_start(self, batch: Samples, batch_idx: int) -> None:
        size = self.first * (self.last / self.first) ** self.progress()
        self.trainer.datamodule.batch_size = round(size)  # type: ignore[attr-defined]


# Encodings


class CoarseToFine(Candidate):
    """Levels of the grid are released one after the other; the others are zero and frozen.

    Args:
        until: share of the training after which the last level is released, at equal intervals.
    """

    def __init__(self, until: float = 0.4, **task: Any) -> None:
        super().__init__(**task)
        self.until = until

    def _held(self) -> Iterator[nn.Parameter]:
        tables = list(self.map.encoding.tables)  # type: ignore[attr-defined]
        for level, table in enumerate(tables[1:], start=1):
            if self.progress() < self.until * level / (len(tables) - 1):
                yield table

    def on_fit_start(self) -> None:
        for table in self._held():
            nn.init.zeros_(table)

    def on_train_batch_start(self, batch: Samples, batch_idx: int) -> None:
        held = {id(table) for table in self._held()}
        for table in self.map.encoding.tables:  # type: ignore[attr-defined]
            table.requires_grad_(id(table) not in held)


class HashGrid(nn.Module):
    """Multi-resolution hash encoding of the plane (Müller et al., SIGGRAPH 2022): C⁰ alone.

    Args:
        in_dim: 2.
        levels: number of levels; their cells per side are in geometric progression.
        coarsest, finest: cells per side of the first and the last level.
        features: of each level; ``out_dim`` is ``2 + levels * features``.
        log2_rows: of the table of a level; larger levels are hashed.
        extent: half the side of the covered square; points outside are clamped to its boundary.
    """

    def __init__(
        self,
        in_dim: int = 2,
        levels: int = 8,
        coarsest: int = 16,
        finest: int = 512,
        features: int = 2,
        log2_rows: int = 14,
        extent: float = 1.05,
    ) -> None:
        super().__init__()
        growth = (finest / coarsest) ** (1 / max(1, levels - 1))
        self.cells = [round(coarsest * growth**level) for level in range(levels)]
        self.extent, self.features = extent, features
        rows = [min((cells + 1) ** 2, 2**log2_rows) for cells in self.cells]
        self.rows, self.offsets = rows, [sum(rows[:level]) for level in range(levels)]
        # the tables of all levels, concatenated
        self.tables = nn.ParameterList([nn.Parameter(1e-2 * torch.randn(sum(rows), features))])
        self.out_dim = in_dim + levels * features

    def _places(self, corner: Tensor) -> Tensor:
        """Rows (L, n) of the table for grid points (L, n, 2)."""
        cells, rows, offsets = (
            torch.tensor(each)[:, None] for each in (self.cells, self.rows, self.offsets)
        )
        direct = corner[..., 0] * (cells + 1) + corner[..., 1]
        hashed = (corner[..., 0] ^ (corner[..., 1] * 2_654_435_761)) % rows
        return offsets + torch.where((cells + 1) ** 2 <= rows, direct, hashed)

    def value_and_jacobian_stack(self, x: Tensor) -> Tensor:
        """Value and both tangents, stacked: (3, N, out_dim)."""
        cells = torch.tensor(self.cells)[:, None, None].to(x)
        per_unit = cells / (2 * self.extent)
        z = (x + self.extent) * per_unit  # (L, N, 2)
        cell = z.detach().floor().clamp(min=0).minimum(cells - 1)
        offset = (z - cell).clamp(0, 1)
        within = (offset == z - cell) * per_unit
        out: Tensor | float = 0.0
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            rows = self._places(cell.long() + torch.tensor([i, j]))
            u, v = (offset[..., k] if bit else 1 - offset[..., k] for k, bit in enumerate((i, j)))
            du, dv = within[..., 0] * (2 * i - 1), within[..., 1] * (2 * j - 1)
            weights = torch.stack([u * v, du * v, u * dv])
            found = self.tables[0].index_select(0, rows.flatten()).view(*rows.shape, -1)
            out = out + weights[..., None] * found  # (3, L, N, F)
        assert isinstance(out, Tensor)
        unit = torch.eye(2).to(x)[:, None].expand(-1, len(x), -1)
        return torch.cat([torch.cat([x[None], unit]), out.transpose(1, 2).flatten(2)], dim=2)

    def forward(self, x: Tensor) -> Tensor:
        return self.value_and_jacobian_stack(x)[0]


def register() -> None:
    """Make ``encoding=hash_grid`` an option: a user's own goes into a file of a conf folder."""
    option = {
        "defaults": [{"override /initialization@_global_.initialization": "random"}, "_self_"],
        "_target_": f"{HashGrid.__module__}.HashGrid",
    }
    ConfigStore.instance().store(group="encoding", name="hash_grid", node=option)


CANDIDATES: dict[str, type[Candidate]] = {
    "gauss_newton": GaussNewton,
    "preconditioned": Preconditioned,
    "by_error": ByError,
    "growing_batch": GrowingBatch,
    "coarse_to_fine": CoarseToFine,
}


def parted(settings: Sequence[str]) -> tuple[list[str], list[str]]:
    """A trial's settings of nsm, and those of its candidate."""
    own = [setting for setting in settings if setting.startswith(("candidate=", "candidate."))]
    return [setting for setting in settings if setting not in own], own


def exchanged(module: Overfit, settings: Sequence[str], progress: Callable[[], float]) -> Overfit:
    """The candidate that the settings select, with the module's network; by default the module."""
    if not settings:
        return module
    name, *rest = settings
    own = OmegaConf.to_container(
        OmegaConf.from_dotlist([setting.removeprefix("candidate.") for setting in rest])
    )
    assert isinstance(own, dict)
    other = CANDIDATES[name.removeprefix("candidate=")](**module.hparams, **own)
    other.map, other.progress = module.map, progress
    return other
