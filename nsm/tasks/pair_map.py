"""PairMap: f: S → T with f∘φ = ψ∘h, through a map h of the domain."""

from __future__ import annotations

from typing import Any

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import (
    blend,
    boundary,
    first_fundamental_form,
    injectivity,
    inside,
    landmark,
    outside,
)
from nsm.maps import Composition, Rotated, build_planar
from nsm.tasks.optimizers import configure
from nsm.tasks.rim import rim
from nsm.tasks.weakest import Weakest

BOUNDARIES = ("exact", "penalty")
LANDMARKS = ("augmented", "fixed")


class PairMap(pl.LightningModule):
    """L = mean E(A, B) + λ_inv G + λ_C C + λ_seam ‖ψ(h(a)) − ψ(h(b))‖² + λ_tri U
    (METHOD, B, G, C).

    A = J_φᵀJ_φ and B = J(ψ∘h)ᵀJ(ψ∘h) at samples of the source. With ``boundary`` exact, h keeps
    to Ω by construction; with penalty, λ_B mean σ(h(∂Ω)) is added, and samples that h sends out
    of Ω leave the distortion and are pulled back. With ``landmarks`` augmented, multipliers are
    updated every ``multiplier_every`` steps (augmented Lagrangian), so that landmarks are met
    whatever λ_C is. U keeps the mesh's triangles from folding (:class:`nsm.tasks.weakest.Weakest`).

    Args:
        map: configuration of h's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps: length of the schedule.
        domain: ``disc`` or ``square``.
        weights: energies by name with their weights (see :mod:`nsm.energies`).
        lambda_injectivity, lambda_boundary, lambda_landmarks, lambda_seam,
            lambda_triangles: the λs.
        boundary: ``exact`` or ``penalty``.
        landmarks: ``augmented`` or ``fixed``.
        multiplier_every: steps between two updates of the multipliers.
        ramp: share of the steps in which the landmarks' targets move from where the start has
            them to where they belong, and λ_seam grows from zero: pulled at once, h would fold.
        points, targets: landmarks P (L, 2) and Q (L, 2) in the domains of source and target.
        seam: (T, 2, 2) pairs of points of ∂Ω that are one point of the source, and whose images
            should be one point of the target.
        mesh: uv (V, 2) and faces (F, 3) of the source, whose triangles must not flip.
        turn: rotation (2, 2) of h's input (see :mod:`nsm.tasks.start`).
        phi, psi: source and target; neither is trained.

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
        turn: Tensor,
        mesh: tuple[Tensor, Tensor],
        phi: nn.Module,
        psi: nn.Module,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(
            ignore=["phi", "psi", "points", "targets", "seam", "turn", "mesh"]
        )
        if not 0 <= ramp <= 1:
            raise ValueError(f"constraints.ramp {ramp} is not in [0, 1]")
        for value, known in ((boundary, BOUNDARIES), (landmarks, LANDMARKS)):
            if value not in known:
                raise ValueError(f"{value!r} is not one of {', '.join(known)}")
        self.energy = blend(weights)
        self.exact, self.augmented = boundary == "exact", landmarks == "augmented"
        planar = build_planar({**map, "onto": domain if self.exact else None})
        self.map = Rotated(planar, turn)
        self.phi = phi.eval().requires_grad_(False)
        self.psi = psi.eval().requires_grad_(False)
        self.image = Composition(self.psi, self.map)
        self.weakest = Weakest(*mesh)
        self.domain = domain
        self.lambdas = {
            "injectivity": lambda_injectivity,
            "boundary": lambda_boundary,
            "landmarks": lambda_landmarks,
            "seam": lambda_seam,
            "triangles": lambda_triangles,
        }
        self.multiplier_every, self.ramp_steps = multiplier_every, ramp * max_steps
        self.register_buffer("points", points, persistent=False)
        self.register_buffer("targets", targets, persistent=False)
        self.register_buffer("start", points @ turn.T, persistent=False)
        self.register_buffer("seam", seam, persistent=False)
        self.register_buffer("rim", rim(domain), persistent=False)
        self.register_buffer("multipliers", torch.zeros_like(points))

    points: Tensor
    targets: Tensor
    start: Tensor
    seam: Tensor
    rim: Tensor
    multipliers: Tensor

    def forward(self, uv: Tensor) -> Tensor:
        """h: (N, 2) points of Ω to (N, 2) in the target's domain."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        distortion, determinant, image = self._distortion(batch.uv)
        terms = {"injectivity": injectivity(determinant).mean()}
        if not self.exact:
            stray = outside(self.domain, image).mean()
            terms["boundary"] = boundary(self.domain, self.map(self.rim)).mean() + stray
        loss = distortion
        if len(self.points):
            moved = self.map(self.points)
            wanted = self.start + self.ramped * (self.targets - self.start)
            terms["landmarks"] = landmark(moved, wanted).sum()
            loss = loss + (self.multipliers * (moved - wanted)).sum()
        if len(self.seam) and self.lambdas["seam"] > 0:
            terms["seam"] = self._seam_gap()
        if self.lambdas["triangles"] > 0:
            terms["triangles"] = self.weakest(self.map, self.global_step)
        for name, value in terms.items():
            share = self.ramped if name == "seam" else 1.0
            loss = loss + share * self.lambdas[name] * value
            self.log(f"train/{name}", value)
        self.log("train/distortion", distortion)
        self.log("train/loss", loss)
        return loss

    def _distortion(self, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean energy at points (N, 2) of Ω, det J_h (N,) and h (N, 2) there."""
        with torch.no_grad():
            source = first_fundamental_form(self.phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        image, jacobian = self.map.value_and_jacobian(uv)
        _, outer = self.psi.value_and_jacobian(image)  # type: ignore[operator]
        energy = self.energy(source, first_fundamental_form(outer @ jacobian))
        if not self.exact:
            energy = energy[inside(self.domain, image)]
        return energy.mean(), torch.linalg.det(jacobian), image

    def _seam_gap(self) -> Tensor:
        """Mean squared distance on the target between the images of a seam point's two copies."""
        a, b = self.image(self.seam.reshape(-1, 2)).reshape(-1, 2, 3).unbind(dim=1)
        return ((a - b) ** 2).sum(dim=1).mean()

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        if not (self.augmented and len(self.points)) or self.ramped < 1:
            return
        if self.global_step % self.multiplier_every == 0:
            with torch.no_grad():
                off = self.map(self.points) - self.targets
                self.multipliers += 2 * self.lambdas["landmarks"] * off

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        distortion, determinant, _ = self._distortion(batch.uv)
        folded = 100 * (determinant <= 0).double().mean()
        self.log("val/distortion", distortion, batch_size=len(batch.uv))
        self.log("val/folded_percent", folded, batch_size=len(batch.uv))

    @property
    def ramped(self) -> float:
        """How far, from 0 to 1, landmarks and seam have come on the way to their full demand."""
        return min(1.0, self.global_step / self.ramp_steps) if self.ramp_steps else 1.0

    def configure_optimizers(self) -> Any:
        return configure(self.map, self.hparams)
