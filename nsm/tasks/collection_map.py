"""CollectionMap: k surfaces, one map h_i of a common domain each, all pairs at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from nsm.energies import blend, boundary, first_fundamental_form, injectivity, landmark
from nsm.maps import Rotated, build_planar
from nsm.tasks.optimizers import configure
from nsm.tasks.pair_map import BOUNDARIES, LANDMARKS
from nsm.tasks.rim import rim
from nsm.tasks.weakest import Weakest


class CollectionMap(pl.LightningModule):
    """Σ over ordered pairs of E(A_i, A_j), A_i = J(φ_i∘h_i)ᵀJ(φ_i∘h_i) (METHOD, Collection).

    F_{i→j}∘φ_i∘h_i = φ_j∘h_j, so each φ_i∘h_i is evaluated once a step, and the k² pairs only
    meet as 2×2 matrices. Each pair's distortion counts by the area of its source i.

    Args:
        map: configuration of each h_i's network.
        optimizer, scheduler, max_steps, domain, weights: as for :class:`nsm.tasks.PairMap`.
        lambda_injectivity, lambda_boundary, lambda_landmarks, lambda_seam, lambda_triangles,
            boundary, landmarks, multiplier_every, ramp: as there.
        points: (K, 2) landmarks in the common domain.
        targets: (k, K, 2) the same in each surface's own.
        seam: (T, 2, 2) pairs of points of the common ∂Ω that are one point of each surface.
        turns: (k, 2, 2) rotations of the inputs.
        mesh: uv (V, 2), in the common domain, and faces (F, 3) of all surfaces together.
        phis: the surfaces; none is trained.

    Raises:
        ValueError: a setting that is not known.
    """

    progress_figure, progress_form = "val/distortion", "distortion {:.3f}"

    def __init__(
        self,
        map: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        max_steps: int,
        domain: str,
        weights: dict[str, float],
        lambda_injectivity: float,
        lambda_boundary: float,
        lambda_landmarks: float,
        lambda_seam: float,
        lambda_triangles: float,
        boundary: str,
        landmarks: str,
        multiplier_every: int,
        ramp: float,
        points: Tensor,
        targets: Tensor,
        seam: Tensor,
        turns: Tensor,
        mesh: tuple[Tensor, Tensor],
        phis: Sequence[nn.Module],
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["phis", "points", "targets", "seam", "turns", "mesh"])
        if not 0 <= ramp <= 1:
            raise ValueError(f"constraints.ramp {ramp} is not in [0, 1]")
        for value, known in ((boundary, BOUNDARIES), (landmarks, LANDMARKS)):
            if value not in known:
                raise ValueError(f"{value!r} is not one of {', '.join(known)}")
        self.energy = blend(weights)
        self.exact, self.augmented = boundary == "exact", landmarks == "augmented"
        onto = domain if self.exact else None
        self.map = nn.ModuleList(
            Rotated(build_planar({**map, "onto": onto}), turn) for turn in turns
        )
        self.phis = nn.ModuleList(phi.eval().requires_grad_(False) for phi in phis)
        self.weakest = nn.ModuleList(Weakest(*mesh) for _ in phis)
        self.domain = domain
        self.multiplier_every, self.ramp_steps = multiplier_every, ramp * max_steps
        self.lambdas = {
            "injectivity": lambda_injectivity,
            "boundary": lambda_boundary,
            "landmarks": lambda_landmarks,
            "seam": lambda_seam,
            "triangles": lambda_triangles,
        }
        self.register_buffer("points", points, persistent=False)
        self.register_buffer("targets", targets, persistent=False)
        self.register_buffer("start", points @ turns.transpose(1, 2), persistent=False)
        self.register_buffer("seam", seam, persistent=False)
        self.register_buffer("rim", rim(domain), persistent=False)
        self.register_buffer("multipliers", torch.zeros_like(targets))
        i, j = torch.meshgrid(torch.arange(len(phis)), torch.arange(len(phis)), indexing="ij")
        self.ordered = (i[i != j], j[i != j])

    points: Tensor
    targets: Tensor
    start: Tensor
    seam: Tensor
    rim: Tensor
    multipliers: Tensor

    def forward(self, x: Tensor) -> Tensor:
        """Points (N, 2) of the common domain to those of all surfaces, (k, N, 2)."""
        return torch.stack([h(x) for h in self.map])

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        distortion, determinant = self._distortion(batch)
        terms = {"injectivity": injectivity(determinant).mean(dim=1).sum()}
        if not self.exact:
            terms["boundary"] = boundary(self.domain, self(self.rim)).mean(dim=1).sum()
        loss = distortion
        if len(self.points):
            moved = self(self.points)
            wanted = self.start + self.ramped * (self.targets - self.start)
            terms["landmarks"] = landmark(moved.flatten(0, 1), wanted.flatten(0, 1)).sum()
            loss = loss + (self.multipliers * (moved - wanted)).sum()
        if len(self.seam) and self.lambdas["seam"] > 0:
            terms["seam"] = self._seam_gap()
        if self.lambdas["triangles"] > 0:
            both = zip(self.map, self.weakest, strict=True)
            terms["triangles"] = torch.stack([w(h, self.global_step) for h, w in both]).sum()
        for name, value in terms.items():
            share = self.ramped if name == "seam" else 1.0
            loss = loss + share * self.lambdas[name] * value
            self.log(f"train/{name}", value)
        self.log("train/distortion", distortion)
        self.log("train/loss", loss)
        return loss

    def _distortion(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean energy over the ordered pairs at points (N, 2), and all det J_h, (k, N)."""
        metrics, determinants = [], []
        for h, phi in zip(self.map, self.phis, strict=True):
            image, inner = h.value_and_jacobian(x)  # type: ignore[operator]
            _, outer = phi.value_and_jacobian(image)  # type: ignore[operator]
            metrics.append(first_fundamental_form(outer @ inner))
            determinants.append(torch.linalg.det(inner))
        forms = torch.stack(metrics)
        # samples lie by the mean of the surfaces' areas: weights make it that of each source
        area = torch.linalg.det(forms.detach()).clamp(min=0).sqrt()
        share = area / area.mean(dim=0).clamp(min=1e-12)
        i, j = self.ordered
        energy = self.energy(forms[i], forms[j])
        weighted = (share[i] * energy).sum(dim=1) / share[i].sum(dim=1).clamp(min=1e-12)
        return weighted.mean(), torch.stack(determinants)

    def _seam_gap(self) -> Tensor:
        """Σ over surfaces of the mean squared distance between a seam point's two copies."""
        both = self.seam.reshape(-1, 2)
        total = both.new_zeros(())
        for h, phi in zip(self.map, self.phis, strict=True):
            a, b = phi(h(both)).reshape(-1, 2, 3).unbind(dim=1)
            total = total + ((a - b) ** 2).sum(dim=1).mean()
        return total

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        if not (self.augmented and len(self.points)) or self.ramped < 1:
            return
        if self.global_step % self.multiplier_every == 0:
            with torch.no_grad():
                off = self(self.points) - self.targets
                self.multipliers += 2 * self.lambdas["landmarks"] * off

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        distortion, determinant = self._distortion(batch)
        folded = 100 * (determinant <= 0).double().mean()
        self.log("val/distortion", distortion, batch_size=len(batch))
        self.log("val/folded_percent", folded, batch_size=len(batch))

    @property
    def ramped(self) -> float:
        """How far, from 0 to 1, landmarks and seam have come on the way to their full demand."""
        return min(1.0, self.global_step / self.ramp_steps) if self.ramp_steps else 1.0

    def configure_optimizers(self) -> Any:
        return configure(self.map, self.hparams)
