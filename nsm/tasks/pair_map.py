"""PairMap: f: S → T with f∘φ = ψ∘h, through a map h of the domain."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.data import Samples
from nsm.energies import At, boundary, first_fundamental_form, inside, outside
from nsm.energies.metrics import determinant
from nsm.maps import Composition, LatticeAligned, Rotated
from nsm.tasks.caps import Caps
from nsm.tasks.constrained import ConstrainedMap
from nsm.tasks.curvature import Curvature
from nsm.tasks.fold_barrier import FoldBarrier, Folds
from nsm.tasks.one_mesh import OneMeshMap
from nsm.tasks.planar import planar_map
from nsm.tasks.terms import Distortion, Evaluation, Term


class PairMap(ConstrainedMap, OneMeshMap):
    """L = mean E(A, B) + λ_inv G + λ_B B + λ_C C + λ_seam S + λ_tri U (METHOD, B, G, C).

    A = J_φᵀJ_φ and B = J(ψ∘h)ᵀJ(ψ∘h) at samples of the source; S = mean ‖ψ(h(a)) − ψ(h(b))‖² over
    the two copies a, b of a seam point; U keeps the source mesh's triangles from folding.

    Args:
        map, activation, encoding: settings of h's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps, domain, energy, loss_weights, constraints, loss_terms: see
            :class:`nsm.tasks.constrained.ConstrainedMap`.
        points, targets: landmarks P (L, 2) and Q (L, 2) in the domains of source and target.
        seam: (T, 2, 2) pairs of points of ∂Ω that are one point of the source, and whose images
            should be one point of the target.
        start: where h starts, a rotation (see :mod:`nsm.tasks.initial_rotation`) or, on a closed
            domain, an affine map: a map around the identity.
        mesh: uv (V, 2) and faces (F, 3) of the source, whose triangles must not flip.
        diagonal: of the target's bounding box, the unit of the logged errors.
        phi, psi: source and target; neither is trained.
        caps: (F,) mask of the faces of caps, whose distortion does not count; None: none.

    Raises:
        ValueError: a constraint that is not known.
    """

    def __init__(
        self,
        map: dict[str, Any],
        activation: dict[str, Any],
        encoding: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        max_steps: int,
        loss_weights: dict[str, float],
        constraints: dict[str, Any],
        domain: Any,
        energy: Any,
        points: Tensor,
        targets: Tensor,
        seam: Tensor,
        start: Rotated | LatticeAligned,
        mesh: tuple[Tensor, Tensor],
        diagonal: float,
        phi: nn.Module,
        psi: nn.Module,
        caps: Tensor | None = None,
        loss_terms: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(domain, energy, loss_weights, constraints, max_steps, loss_terms)
        given = ["domain", "energy", "phi", "psi", "points", "targets", "seam", "start", "mesh"]
        self.save_hyperparameters(ignore=given, logger=False)
        h = planar_map(domain if self.exact else None, map, activation, encoding)
        self.map = start.around(h)
        self.phi = phi.eval().requires_grad_(False)
        self.psi = psi.eval().requires_grad_(False)
        self.image = Composition(self.psi, self.map)
        held = self.constraints
        self.folds = Folds(held.injectivity)
        self.fold_barrier = FoldBarrier(*mesh, margin=held.fold_margin, every=held.fold_every)
        uv, faces = mesh
        part = faces if caps is None else faces[~caps]
        self.set_quadrature(held.triangles_from, max_steps, uv, part, self.phi)
        self.caps = None if caps is None else Caps(uv, faces[caps], self.phi, held.injectivity)
        self.diagonal = diagonal
        self.set_landmarks(points, targets, self.map.before(points), seam)

    def forward(self, uv: Tensor) -> Tensor:
        """h: (N, 2) points of Ω to (N, 2) in the target's domain."""
        return self.map(uv)

    def training_step(self, batch: Samples, batch_idx: int) -> Tensor:
        self.batch = batch
        w, ramp = self.loss_weights, self.ramp
        distortion, evaluation = self._evaluated(batch)
        energy = distortion.mean
        self.distortion = energy.detach()
        G = self._folding(evaluation)
        B = 0.0 if self.exact else self._boundary_term(evaluation.image)
        S = self._seam_gap() if len(self.seam) and w.seam > 0 else 0.0
        U = self._weakest() if w.triangles > 0 else 0.0
        K = self._cap_term() if self.caps is not None else 0.0
        C, multipliers = self.landmark_terms()

        loss = (
            energy
            + multipliers
            + w.injectivity * G
            + w.boundary * B
            + ramp * w.seam * S
            + w.triangles * U
            + K
            + self.landmark_weight * C
        )
        terms: dict[str, Term] = {
            **distortion.terms,
            "multipliers": (1.0, multipliers),
            "injectivity": (w.injectivity, G),
            "boundary": (w.boundary, B),
            "seam": (ramp * w.seam, S),
            "triangles": (w.triangles, U),
            "caps": (1.0, K),
            "landmarks": (self.landmark_weight, C),
        }
        for name, term in self.loss_terms.items():
            terms[name] = (term.weight, term(evaluation))
            loss = loss + term.weight * terms[name][1]
        self.log_terms(loss, terms, distortion=energy)
        return loss

    def _evaluated(self, batch: Samples) -> tuple[Distortion, Evaluation]:
        """The energy at samples of the source, and what it is made from."""
        if self.training and (some := self.triangles(len(batch.uv))) is not None:
            h = self.map(some.uv)
            return self._on_triangles(some, h, some.forms(self.psi(h)))
        A, B, jacobian, h = self.pointwise(self._at, batch.uv)
        parts = self.energy.parts(A, B, At(batch.uv, batch.points))
        if not self.exact:  # samples that h maps out of Ω do not count
            kept = inside(self.domain, h)
            parts = {name: part[kept] for name, part in parts.items()}
        det = determinant(jacobian)
        return Distortion(self.energy, parts), Evaluation(batch.uv, batch.points, h, A, B, det)

    def _at(self, uv: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A, B, J_h and h at points (N, 2) of Ω."""
        with torch.no_grad():
            source = first_fundamental_form(self.phi.value_and_jacobian(uv)[1])  # type: ignore[operator]
        image, jacobian = self.map.value_and_jacobian(uv)
        _, outer = self.psi.value_and_jacobian(image)  # type: ignore[operator]
        return source, first_fundamental_form(outer @ jacobian), jacobian, image

    def _cap_term(self) -> Tensor:
        assert self.caps is not None
        w, step = self.loss_weights.injectivity, self.global_step
        return self.caps(self.map, self.psi, self.energy, w, step)

    def curvatures(self) -> list[Curvature]:
        w = self.loss_weights
        places = self._places(self.batch)
        uv = places.uv
        with torch.no_grad():
            source, _, jacobian, image = self._at(uv)
            outer = self.psi.value_and_jacobian(image)[1].double()  # type: ignore[operator]

        def metric(j: Tensor) -> Tensor:
            return first_fundamental_form(outer @ j)

        hessians = self._hessians(places, source, jacobian, metric, w.injectivity)
        found = [Curvature(self.map, uv, hessians)]
        if self.caps is not None:
            step = self.global_step
            found.append(self.caps.curvature(self.map, self.psi, self.energy, w.injectivity, step))
        found += self.constraint_curvatures(self.map, self.psi, self.held)
        return found

    def _boundary_term(self, image: Tensor) -> Tensor:
        """Mean squared distance of h(∂Ω) to ∂Ω, and of samples outside Ω to Ω."""
        stray = outside(self.domain, image).mean()
        return boundary(self.domain, self.map(self.boundary_samples)).mean() + stray

    def _seam_gap(self) -> Tensor:
        """Mean squared distance on the target between the images of a seam point's two copies."""
        a, b = self.image(self.seam.reshape(-1, 2)).reshape(-1, 2, 3).unbind(dim=1)
        return ((a - b) ** 2).sum(dim=1).mean()

    def validation_step(self, batch: Samples, batch_idx: int) -> None:
        self.log_validation(*self._evaluated(batch))

    def flipped_percent(self) -> Tensor:
        return self.fold_barrier.flipped_percent(self.map)

    def landmark_error(self) -> Tensor:
        off = self.image(self.points) - self.psi(self.targets)
        return 100 / self.diagonal * off.norm(dim=1)
