"""Overfit: a network φ: Ω → R³ is trained to be the surface (METHOD, Eq. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor

from nsm.data import Samples
from nsm.energies.overfit import normal, position
from nsm.maps import batched, build_map
from nsm.tasks.ensemble import Ensemble
from nsm.tasks.optimizers import configure
from nsm.tasks.terms import Term
from nsm.tasks.training import Training


class Overfit(Training):
    """L = mean ‖f − φ‖² + λ_n mean ‖n_φ − n_f‖² over samples of the surface.

    Args:
        map: configuration of the network (see :class:`nsm.maps.NeuralMap`).
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        lambda_normal: λ_n; 0 leaves the normal term out.
        max_steps: length of the schedule.
        diagonal: of the surface's bounding box, the unit of the errors that are logged.
    """

    progress_figure, progress_form = "val/rms_percent", "error {:.3f} %"

    def __init__(
        self,
        map: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        lambda_normal: float,
        max_steps: int,
        diagonal: float,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.map = build_map(map)
        self.lambda_normal, self.diagonal = lambda_normal, diagonal

    def forward(self, uv: Tensor) -> Tensor:
        """(N, 2) points of Ω to (N, 3)."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        if self.lambda_normal == 0:
            (value,) = self.pointwise(lambda uv: (self.map(uv),), batch.uv)
            return self.summed(_terms(value, None, batch, self.lambda_normal))
        value, jacobian = self.pointwise(self.map.value_and_jacobian, batch.uv)
        return self.summed(_terms(value, jacobian, batch, self.lambda_normal))

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        value, jacobian = self.map.value_and_jacobian(batch.uv)
        self.logged(_held_out(value, jacobian, batch), batch_size=len(value))

    def on_validation_epoch_end(self) -> None:
        # the root is taken after the mean over all batches
        squared = self.trainer.callback_metrics[_SQUARED]
        self.log("val/rms_percent", 100 * squared.sqrt() / self.diagonal)

    def configure_optimizers(self) -> Any:
        return configure(self.map, self.hparams)


def _terms(
    value: Tensor, jacobian: Tensor | None, batch: Samples, lambda_normal: float | Tensor
) -> dict[str, Term]:
    """The terms of Eq. 1 for values (..., N, 3), that of normals where there are Jacobians
    (..., N, 3, 2): means over N samples, (...)."""
    terms: dict[str, Term] = {
        "position": (1.0, position(value, batch.points).mean(dim=-1)),
    }
    if jacobian is not None:
        terms["normal"] = (lambda_normal, normal(jacobian, batch.normals).mean(dim=-1))
    return terms


_SQUARED = "val/mean_squared_distance"


def _held_out(value: Tensor, jacobian: Tensor, batch: Samples) -> dict[str, Tensor]:
    """Errors at held-out points, for the log: means over N samples, (...)."""
    cross = torch.linalg.cross(jacobian[..., 0], jacobian[..., 1])
    cosine = torch.nn.functional.cosine_similarity(cross, batch.normals, dim=-1)
    return {
        _SQUARED: position(value, batch.points).mean(dim=-1),
        "val/normal_error_degrees": torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).mean(dim=-1),
    }


class OverfitEnsemble(Ensemble):
    """k surfaces at once, each as :class:`Overfit` has it, with the networks in one batch.

    Args:
        each: their modules, with networks of one configuration; seeds, λ_n and the optimiser's
            rates may differ.
    """

    progress_figure, progress_form = "val/rms_percent", "largest error {:.3f} %"

    def __init__(self, each: Sequence[Overfit]) -> None:
        super().__init__(each)
        self._batched = (batched([one.map for one in each]),)  # no module of its own
        self.some_normals = any(one.lambda_normal != 0 for one in each)
        lambdas, units = ([getattr(o, a) for o in each] for a in ("lambda_normal", "diagonal"))
        self.register_buffer("lambda_normal", torch.tensor(lambdas), persistent=False)
        self.register_buffer("units", torch.tensor(units), persistent=False)

    lambda_normal: Tensor
    units: Tensor

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        value, jacobian = self._evaluated(batch.uv)
        with_normals = jacobian if self.some_normals else None
        return self.summed(_terms(value, with_normals, batch, self.lambda_normal)).sum()

    def _evaluated(self, uv: Tensor) -> tuple[Tensor, ...]:
        """Values (k, N, 3) and Jacobians (k, N, 3, 2)."""

        def by_point(x: Tensor) -> tuple[Tensor, ...]:
            both = self._batched[0].value_and_jacobian(x.transpose(0, 1))
            return tuple(part.transpose(0, 1) for part in both)

        return tuple(part.transpose(0, 1) for part in self.pointwise(by_point, uv.transpose(0, 1)))

    def tells(self, index: int, name: str) -> bool:
        return not name.endswith("/normal") or cast(Overfit, self.each[index]).lambda_normal != 0

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        value, jacobian = self._batched[0].value_and_jacobian(batch.uv)
        self.logged(_held_out(value, jacobian, batch), batch_size=value.shape[1])

    def on_validation_epoch_end(self) -> None:
        known = self.trainer.callback_metrics
        squared = torch.stack([known[f"{_SQUARED}@{i}"] for i in range(len(self.each))])
        error = 100 * squared.sqrt().to(self.units) / self.units
        self.logged({"val/rms_percent": error})
        self.log("val/rms_percent", error.max(), logger=False)
