"""Overfit: a network φ: Ω → R³ is trained to be the surface (METHOD, Eq. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies.overfit import normal, position
from nsm.maps import build_map, together
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
        squared = position(value, batch.points).mean()
        cross = torch.linalg.cross(jacobian[:, :, 0], jacobian[:, :, 1])
        cosine = torch.nn.functional.cosine_similarity(cross, batch.normals)
        angle = torch.rad2deg(torch.acos(cosine.clamp(-1, 1))).mean()
        self.log("val/mean_squared_distance", squared, batch_size=len(value))
        self.log("val/normal_error_degrees", angle, batch_size=len(value))

    def on_validation_epoch_end(self) -> None:
        # the root is taken after the mean over all batches
        squared = self.trainer.callback_metrics["val/mean_squared_distance"]
        self.log("val/rms_percent", 100 * squared.sqrt() / self.diagonal)

    def configure_optimizers(self) -> Any:
        return configure(self.map, self.hparams)


def _terms(
    value: Tensor, jacobian: Tensor | None, batch: Samples, lambda_normal: float
) -> dict[str, Term]:
    """The terms of Eq. 1, that of normals where there are Jacobians (..., N, 3, 2): means over N
    samples, summed over the surfaces where there are several."""
    terms: dict[str, Term] = {
        "position": (1.0, position(value, batch.points).mean(dim=-1).sum()),
    }
    if jacobian is not None:
        turn = normal(jacobian, batch.normals).mean(dim=-1).sum()
        terms["normal"] = (lambda_normal, turn)
    return terms


class OverfitSeveral(Training):
    """k surfaces at once, each as :class:`Overfit` has it, with the networks in one batch.

    The loss is the sum of theirs and no network sees another's share of it, so that each becomes
    what it would alone.

    Args:
        seed: of each network's start.
        map, optimizer, scheduler, lambda_normal, max_steps: of each, as for :class:`Overfit`.
        diagonals: of the surfaces' bounding boxes, the units of the errors that are logged.
    """

    progress_figure, progress_form = "val/rms_percent", "largest error {:.3f} %"

    def __init__(
        self,
        seed: int,
        map: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        lambda_normal: float,
        max_steps: int,
        diagonals: Sequence[float],
    ) -> None:
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.maps = nn.ModuleList()
        for _ in diagonals:
            pl.seed_everything(seed, verbose=False)
            self.maps.append(build_map(map))
        self.lambda_normal = lambda_normal
        self.register_buffer("units", torch.tensor(diagonals), persistent=False)

    units: Tensor

    def forward(self, uv: Tensor) -> Tensor:
        """(k, N, 2) points, N of each surface's Ω, to (k, N, 3)."""
        every: Tensor = together(list(self.maps))(uv)
        return every

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        value, jacobian = self._evaluated(batch.uv)
        with_normals = jacobian if self.lambda_normal > 0 else None
        return self.summed(_terms(value, with_normals, batch, self.lambda_normal))

    def _evaluated(self, uv: Tensor) -> tuple[Tensor, ...]:
        """Values (k, N, 3) and Jacobians (k, N, 3, 2)."""

        def by_point(x: Tensor) -> tuple[Tensor, ...]:
            both = together(list(self.maps)).value_and_jacobian(x.transpose(0, 1))
            return tuple(part.transpose(0, 1) for part in both)

        return tuple(part.transpose(0, 1) for part in self.pointwise(by_point, uv.transpose(0, 1)))

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        value = self(batch.uv)
        for k, squared in enumerate(position(value, batch.points).mean(dim=1)):
            self.log(f"val/mean_squared_distance_{k}", squared, batch_size=value.shape[1])

    def on_validation_epoch_end(self) -> None:
        squared = [
            self.trainer.callback_metrics[f"val/mean_squared_distance_{k}"]
            for k in range(len(self.maps))
        ]
        error = 100 * torch.stack(squared).sqrt().to(self.units) / self.units
        self.log("val/rms_percent", error.max())

    def configure_optimizers(self) -> Any:
        return configure(self.maps, self.hparams)
