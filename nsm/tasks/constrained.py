"""What maps between surfaces share: how the planar map h is constrained (METHOD, B, G, C)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.energies import first_fundamental_form, inside, landmark
from nsm.settings import PairConstraints, PairWeights
from nsm.tasks.at_triangles import AtTriangles
from nsm.tasks.curvature import Curvature
from nsm.tasks.fold_barrier import further_training, stronger
from nsm.tasks.terms import Distortion, Evaluation, HeldOut, as_blend, made_terms

# float32 places a point of the boundary no better than this
_ON_BOUNDARY = 1e-6
# share of λ_C with which the ramp of the weights begins
_FIRST = 1e-3
# factor of λ_C at triangles, where few steps are left to meet the landmarks
_LAST = 10.0
# more than any value that is reached, and finite as all of a checkpoint
_NEVER = torch.finfo(torch.float32).max
_MET = 0.02  # in percent of the target's diagonal: landmarks that are nearer are met
# share of the flipped triangles: while a step leaves less of them, the next one is worth its time.
# Where fewer turn back, the repair does it
_OPENED = 0.5
# in units of Ω: where there is a seam, a landmark that is farther off once λ_C is in full lies on
# the other side of it; more force only folds the map
_LOST = 0.1


class ConstrainedMap(AtTriangles):
    """Base of the tasks that map surfaces to surfaces.

    With ``constraints.boundary=exact``, or on a closed domain, h maps Ω to itself by construction;
    with ``penalty``, λ_B times the mean squared distance of h(∂Ω) to ∂Ω is added, and samples that
    h maps out of Ω leave the distortion and are pulled back. With
    ``constraints.landmarks=augmented``, multipliers are updated every ``multiplier_every`` steps
    (at triangles, each step) once the ramp is over (augmented Lagrangian), so that landmarks are
    met whatever λ_C is; with ``fixed``, λ_C acts alone. During the ramp, a share of the steps, the
    landmarks' targets move from where h has them at its start to their places
    (``constraints.ramp_of=targets``) or λ_C grows from a thousandth (``weights``), and the seam's
    weight grows from zero: with the full terms at once, h would fold. Where there is a seam,
    multipliers hold no landmark that is still far off, and where the steps at triangles begin, such
    a one is let go: it is missed, which figures tell, and the others are met without folds.

    Quasi-Newton steps at triangles end where a step changes the distortion by less than
    ``constraints.settled``, all landmarks are met, and more than half as many triangles are flipped
    as before it: maps of like shapes take few.

    Subclasses set ``map``, call ``set_landmarks``, keep the distortion of each evaluation in
    ``distortion``, and define ``flipped_percent`` and ``landmark_error``.

    Args:
        domain: Ω (see :class:`nsm.domains.Domain`).
        energy: of the metrics A and B (see :mod:`nsm.energies`).
        loss_weights: of :class:`nsm.settings.PairWeights`: λ_inv, λ_B, λ_C, λ_seam of the squared
            gap along the seam, and λ_tri of triangles that are near to folding.
        constraints: of :class:`nsm.settings.PairConstraints`.
        max_steps: length of the run.
        loss_terms: the user's own (see :mod:`nsm.tasks.terms`).

    Raises:
        ValueError: a constraint that is not known.
    """

    Weights, Constraints = PairWeights, PairConstraints
    points: Tensor
    targets: Tensor
    start: Tensor
    there: Tensor
    seam: Tensor
    boundary_samples: Tensor
    multipliers: Tensor
    lost: Tensor
    reached: Tensor
    flipped: Tensor
    settled: Tensor

    def __init__(
        self,
        domain: Any,
        energy: Any,
        loss_weights: dict[str, float],
        constraints: dict[str, Any],
        max_steps: int,
        loss_terms: dict[str, Any] | None,
    ) -> None:
        super().__init__()
        self.domain, self.energy = domain, as_blend(energy)
        self.loss_weights = PairWeights(**loss_weights)
        self.constraints = self.Constraints(**constraints)
        self.loss_terms = made_terms(loss_terms or {})
        self.held_out = HeldOut()
        self.weighed = 0.0  # λ_C of the step that is made
        self.distortion: Tensor | None = None
        self.register_buffer("reached", torch.tensor(_NEVER))  # at the end of the last step
        self.register_buffer("flipped", torch.tensor(_NEVER))  # and then, in percent
        self.register_buffer("settled", torch.tensor(False))
        self.ramp_steps = self.constraints.ramp * max_steps
        self.multipliers_from = self.constraints.multipliers_from * max_steps
        # h maps Ω to itself by construction
        self.exact = not domain.has_boundary or self.constraints.boundary == "exact"

    def set_landmarks(self, points: Tensor, targets: Tensor, start: Tensor, seam: Tensor) -> None:
        """Register landmarks: points (K, 2), their targets and where h has them at its start
        (..., K, 2), and pairs of points of ∂Ω (T, 2, 2) whose images should be one point.

        A target is NaN where a surface lacks the landmark. On a closed domain, the targets are the
        lifts that h should meet.
        """
        there = torch.isfinite(targets).all(dim=-1)
        targets = torch.where(there[..., None], targets, start)
        given = {"points": points, "targets": targets, "start": start, "seam": seam, "there": there}
        if not self.exact:
            given["boundary_samples"] = self.domain.boundary_samples()
        for name, tensor in given.items():
            self.register_buffer(name, tensor, persistent=False)
        self.register_buffer("multipliers", torch.zeros_like(targets))
        self.register_buffer("lost", torch.zeros_like(there))  # let go

    @property
    def ramp(self) -> float:
        """From 0 to 1: how far the landmarks' targets and the seam's weight have come."""
        return min(1.0, self.global_step / self.ramp_steps) if self.ramp_steps else 1.0

    @property
    def loss_changes(self) -> bool:
        return super().loss_changes or self.global_step - 1 < self.ramp_steps

    @property
    def landmark_weight(self) -> float:
        """λ_C, as far as it has risen on the ramp; more at triangles."""
        raised = self.constraints.ramp_of == "weights"
        share = _FIRST ** (1 - self.ramp) if raised else 1.0
        if self.global_step >= self.triangles_from:
            share *= _LAST
        return self.loss_weights.landmarks * share

    @property
    def may_end_early(self) -> bool:
        return super().may_end_early and self.global_step >= self.triangles_from

    @property
    def held(self) -> Tensor:
        """Mask (..., K) of the landmarks that the map should meet."""
        return self.there & ~self.lost

    def landmark_terms(self) -> tuple[Tensor | float, Tensor | float]:
        """C = Σ ‖h(P) − Q_t‖² and the multipliers' Σ μ·(h(P) − Q_t), Q_t the target, which may
        move on the ramp, over the landmarks that there are; 0.0 where there are none."""
        if not len(self.points):
            return 0.0, 0.0
        self.weighed = self.landmark_weight
        moved = self(self.points)
        wanted = self.targets
        if self.constraints.ramp_of == "targets":
            wanted = self.start + self.ramp * (self.targets - self.start)
        multipliers: Tensor | float = 0.0
        C = (self.held * landmark(moved, wanted)).sum()
        if self.constraints.landmarks == "augmented":
            multipliers = (self.multipliers * (moved - wanted)).sum()
        return C, multipliers

    def constraint_curvatures(
        self, h: nn.Module, surface: nn.Module, held: Tensor, scale: float = 1.0
    ) -> list[Curvature]:
        """Those of the terms C and S of one map.

        Args:
            h: the map.
            surface: where it leads to.
            held: (K,) mask of the landmarks that it should meet.
            scale: factor of both terms.
        """
        found = []
        if len(self.points):
            identity = torch.eye(2, dtype=self.points.dtype, device=self.points.device)
            of_landmarks = 2 * scale * self.landmark_weight * identity
            found.append(Curvature(h, self.points, held[:, None, None] * of_landmarks))
        if len(self.seam) and self.loss_weights.seam > 0:
            ends = self.seam.reshape(-1, 2)
            with torch.no_grad():
                tangents = surface.value_and_jacobian(h(ends))[1]  # type: ignore[operator]
            # of both ends of a gap alone, without the product of the two
            gap = 2 * scale * self.ramp * self.loss_weights.seam / len(self.seam)
            found.append(Curvature(h, ends, gap * first_fundamental_form(tangents)))
        return found

    def on_train_start(self) -> None:
        super().on_train_start()
        if self.settled:  # as a resumed training may have been
            self.trainer.should_stop = True

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_end(outputs, batch, batch_idx)
        self._hold_landmarks()
        if self.global_step > self.triangles_from and self.may_end_early:
            self._stop_if_settled()

    @property
    def is_over(self) -> bool:
        return super().is_over or bool(self.settled)

    def _stop_if_settled(self) -> None:
        assert self.distortion is not None
        change = (self.reached / self.distortion - 1).abs()
        with torch.no_grad():
            missed = len(self.points) > 0 and bool((self.landmark_error()[self.held] > _MET).any())
            flipped = self.flipped_percent()
        opening = bool(flipped < _OPENED * self.flipped)
        self.reached, self.flipped = self.distortion.to(self.reached), flipped
        if change < self.constraints.settled and not missed and not opening:
            self.settled.fill_(True)
            self.trainer.should_stop = True

    def _hold_landmarks(self) -> None:
        """Let landmarks go that no force meets, and raise the multipliers of the others."""
        settings = self.constraints
        if not len(self.points) or self.ramp < 1:
            return
        with torch.no_grad():
            if self.begins_at_triangles:
                self.lost |= ~self._near(self(self.points) - self.targets)
                self.multipliers *= ~self.lost[..., None]
            if settings.landmarks != "augmented" or self.global_step < self.multipliers_from:
                return
            # at triangles a step is far longer, and nearer to the minimum
            every = 1 if self.global_step > self.triangles_from else settings.multiplier_every
            if self.global_step % every == 0:
                off = self(self.points) - self.targets
                known = self.held & self._near(off)
                self.multipliers += 2 * self.weighed * off * known[..., None]

    def _near(self, off: Tensor) -> Tensor:
        """Mask (..., K) of the landmarks that can be met, by what they are off (..., K, 2)."""
        return off.norm(dim=-1) < (_LOST if len(self.seam) else torch.inf)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        for name in (
            "lost",
            "reached",
            "flipped",
            "settled",
        ):  # an earlier version's are as they are at first
            checkpoint["state_dict"].setdefault(name, getattr(self, name))

    def strengthen(self, steps: int) -> None:
        """Prepare a further training of a nearly injective map: the ramp is over, the weight of
        folding triangles is ten times as large and acts on more of them, in small steps."""
        self.loss_weights = stronger(self.loss_weights)
        self.ramp_steps = self.multipliers_from = 0.0
        for reached in (self.reached, self.flipped):
            reached.fill_(_NEVER)
        self.settled.fill_(False)
        further_training(self, steps)

    def log_validation(self, distortion: Distortion, evaluation: Evaluation) -> None:
        """Log held-out figures: distortion, folds, and samples outside Ω."""
        determinant, images = evaluation.determinant, evaluation.image
        count = determinant.shape[-1]
        self.held_out.add(distortion)
        self.log("val/distortion", distortion.mean, batch_size=count)
        folded = 100 * (determinant <= 0).double().mean()
        self.log("val/folded_percent", folded, batch_size=count)
        if self.domain.has_boundary:
            stray = ~inside(self.domain, images, tolerance=_ON_BOUNDARY)
            self.log("val/outside_percent", 100 * stray.double().mean(), batch_size=count)

    def on_validation_epoch_end(self) -> None:
        self.log("val/distortion_median", self.held_out.median())
        self.log("val/flipped_percent", self.flipped_percent())
        if len(self.points):
            error = self.landmark_error()[self.there]
            self.log("val/landmark_error_mean_percent", error.mean())
            self.log("val/landmark_error_max_percent", error.max())

    def flipped_percent(self) -> Tensor:
        """Share of mesh triangles that h flips: a scalar."""
        raise NotImplementedError

    def landmark_error(self) -> Tensor:
        """Distances (..., K) of landmarks from their targets, on the surface, in percent of its
        diagonal."""
        raise NotImplementedError
