"""What maps between surfaces share: constraints on planar maps, and how they set in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nsm.domains import bounded
from nsm.energies import Blend, inside, landmark
from nsm.tasks.fold_barrier import carefully, stronger
from nsm.tasks.optimizers import configure
from nsm.tasks.terms import Distortion, HeldOut, Term
from nsm.tasks.training import Training

BOUNDARIES = ("exact", "penalty")
LANDMARKS = ("augmented", "fixed")
# Float32 places a point of the boundary this well, and no better.
_ON_BOUNDARY = 1e-6


@dataclass(frozen=True)
class Constraints:
    """How maps of the domain are held (METHOD, B, G, C).

    Attributes:
        boundary: ``exact``, h keeps to Ω by construction; or ``penalty``, λ_B mean σ(h(∂Ω)) is
            added, and samples that h sends out of Ω leave the distortion and are pulled back.
        landmarks: ``augmented``, multipliers are updated every ``multiplier_every`` steps once
            the ramp is over (augmented Lagrangian), so that landmarks are met whatever λ_C is; or
            ``fixed``, λ_C alone.
        multiplier_every: steps between two updates of the multipliers.
        ramp: share of the steps in which the landmarks' targets move from where the start has
            them to where they belong, and λ_seam grows from zero: pulled at once, h would fold.
        lambda_injectivity, lambda_boundary, lambda_landmarks, lambda_seam, lambda_triangles: the
            weights λ_inv, λ_B, λ_C, that of the seam's gap on the target, and that of the mesh
            triangles nearest to folding (:class:`nsm.tasks.fold_barrier.FoldBarrier`).

    Raises:
        ValueError: a word that is not known, or a ramp outside [0, 1].
    """

    boundary: str
    landmarks: str
    multiplier_every: int
    ramp: float
    lambda_injectivity: float
    lambda_boundary: float
    lambda_landmarks: float
    lambda_seam: float
    lambda_triangles: float

    def __post_init__(self) -> None:
        for value, known in ((self.boundary, BOUNDARIES), (self.landmarks, LANDMARKS)):
            if value not in known:
                raise ValueError(f"{value!r} is not one of {', '.join(known)}")
        if not 0 <= self.ramp <= 1:
            raise ValueError(f"constraints.ramp {self.ramp} is not in [0, 1]")

    def onto(self, domain: str) -> str | None:
        """The domain that h keeps to by construction, if it does."""
        return domain if self.boundary == "exact" else None


class ConstrainedMap(Training):
    """Base of the tasks that map surfaces to surfaces.

    Subclasses set ``map``, call ``hold`` with the landmarks, sum their terms by ``total``, and
    answer ``flipped_percent`` and ``landmark_error``.

    Args:
        domain: ``disc`` or ``square``.
        weights: energies by name with their weights (see :mod:`nsm.energies`).
        constraints: of :class:`Constraints`.
        max_steps: length of the run.

    Raises:
        ValueError: a setting that is not known.
    """

    progress_figure, progress_form = "val/distortion", "distortion {:.3f}"
    points: Tensor
    targets: Tensor
    start: Tensor
    seam: Tensor
    rim: Tensor
    multipliers: Tensor

    def __init__(
        self,
        domain: str,
        weights: dict[str, float],
        constraints: dict[str, Any],
        max_steps: int,
    ) -> None:
        super().__init__()
        self.domain, self.energy = domain, Blend(weights)
        self.held_out = HeldOut()
        self.constraints = Constraints(**constraints)
        self.ramp_steps = self.constraints.ramp * max_steps

    def hold(self, points: Tensor, targets: Tensor, start: Tensor, seam: Tensor) -> None:
        """Take landmarks: points (K, 2), their targets and where h has them at its start
        (..., K, 2), and pairs of points of ∂Ω (T, 2, 2) whose images should be one point."""
        named = {"points": points, "targets": targets, "start": start, "seam": seam}
        named["boundary_samples"] = bounded(self.domain).boundary_samples()
        for name, tensor in named.items():
            self.register_buffer(name, tensor, persistent=False)
        self.register_buffer("multipliers", torch.zeros_like(targets))

    @property
    def ramped(self) -> float:
        """How far, from 0 to 1, landmarks and seam have come on the way to their full demand."""
        return min(1.0, self.global_step / self.ramp_steps) if self.ramp_steps else 1.0

    def total(self, distortion: Distortion, terms: dict[str, Tensor]) -> Tensor:
        """The loss, with each term by its λ and, if there are any, with the landmarks; logged."""
        every: dict[str, Term] = dict(distortion.terms)
        if len(self.points):
            moved = self(self.points)
            wanted = self.start + self.ramped * (self.targets - self.start)
            terms = {**terms, "landmarks": landmark(moved, wanted).sum()}
            if self.constraints.landmarks == "augmented":
                every["multipliers"] = (1.0, (self.multipliers * (moved - wanted)).sum())
        for name, value in terms.items():
            share = self.ramped if name == "seam" else 1.0
            every[name] = (share * getattr(self.constraints, f"lambda_{name}"), value)
        self.note({"distortion": distortion.mean})
        return self.summed(every)

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        held = self.constraints
        if held.landmarks != "augmented" or not len(self.points) or self.ramped < 1:
            return
        if self.global_step % held.multiplier_every == 0:
            with torch.no_grad():
                off = self(self.points) - self.targets
                self.multipliers += 2 * held.lambda_landmarks * off

    def strengthen(self, steps: int) -> None:
        """Set up for a further training of what is nearly there: all demands in full, those on
        triangles tenfold and on more of them, in small steps."""
        held = self.constraints
        self.constraints = replace(held, lambda_triangles=stronger(held.lambda_triangles))
        self.ramp_steps = 0.0
        carefully(self, steps)

    def log_validation(self, distortion: Distortion, determinant: Tensor, image: Tensor) -> None:
        """Log what is followed on held-out points: energy, and the shares of folds and of strays.

        Args:
            distortion: there.
            determinant: det J_h (..., N).
            image: h (..., N, 2).
        """
        count = image.shape[-2]
        self.held_out.add(distortion)
        folded, stray = determinant <= 0, ~inside(self.domain, image, tolerance=_ON_BOUNDARY)
        self.log("val/distortion", distortion.mean, batch_size=count)
        self.log("val/folded_percent", 100 * folded.double().mean(), batch_size=count)
        self.log("val/outside_percent", 100 * stray.double().mean(), batch_size=count)

    def on_validation_epoch_end(self) -> None:
        self.log("val/distortion_median", self.held_out.median())
        self.log("val/flipped_percent", self.flipped_percent())
        if len(self.points):
            error = self.landmark_error()
            self.log("val/landmark_error_mean_percent", error.mean())
            self.log("val/landmark_error_max_percent", error.max())

    def flipped_percent(self) -> Tensor:
        """Share of mesh triangles that h flips: a scalar."""
        raise NotImplementedError

    def landmark_error(self) -> Tensor:
        """Distance of landmarks from their targets, on the surface, in percent of its diagonal."""
        raise NotImplementedError

    def configure_optimizers(self) -> Any:
        return configure(self.map, self.hparams)  # type: ignore[arg-type]
