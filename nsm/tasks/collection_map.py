"""CollectionMap: k surfaces, one map h_i of a common domain each, all pairs at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from nsm.energies import At, boundary, first_fundamental_form, inside, outside
from nsm.energies.metrics import determinant
from nsm.maps import LatticeAligned, Rotated, batched
from nsm.maps.batched_maps import OneByOne
from nsm.settings import CollectionConstraints
from nsm.tasks.collection_quadrature import CollectionQuadrature, Turn
from nsm.tasks.constrained import ConstrainedMap
from nsm.tasks.curvature import Curvature, positive_hessians
from nsm.tasks.fold_barrier import FoldBarrier, Folds
from nsm.tasks.planar import planar_map
from nsm.tasks.terms import Distortion, Evaluation, Term

# The terms of four surfaces are added up; those of k surfaces are scaled to that many. The default
# weights were measured with four surfaces.
_SURFACES = 4


class CollectionMap(ConstrainedMap):
    """L = mean over i ≠ j of E(A_i, A_j) + 4/k Σ_i (λ_inv G_i + λ_B B_i + λ_C C_i + λ_seam S_i +
    λ_tri U_i), A_i = J(φ_i∘h_i)ᵀJ(φ_i∘h_i) (METHOD, Collection).

    F_{i→j}∘φ_i∘h_i = φ_j∘h_j, so each φ_i∘h_i is evaluated once a step, and the k(k − 1) ordered
    pairs only meet as 2×2 matrices. The distortion of a pair is weighted by the area of its source
    i. The loss is METHOD's sum over all ordered pairs, divided by k(k − 1): each surface takes
    part in 2(k − 1) pairs, so its energy and its constraints have the same proportion for all k,
    and the loss does not grow with k. Four is the number of surfaces for which the default weights
    were measured. Multipliers are scaled like the term C. With ``constraints.pairs=sum`` the loss
    is METHOD's: the sum over all ordered pairs, and Σ_i of the other terms without the 4/k.

    Args:
        map, activation, encoding: settings of each h_i's network.
        optimizer, scheduler: settings (see :mod:`nsm.tasks.optimizers`).
        max_steps, domain, energy, loss_weights, constraints, loss_terms: see
            :class:`nsm.tasks.constrained.ConstrainedMap`.
        points: (K, 2) landmarks in the common domain.
        targets: (k, K, 2) the same in each surface's own; NaN where a surface lacks the landmark.
        seam: (T, 2, 2) pairs of points of the common ∂Ω that are one point of each surface.
        starts: where each h_i starts, a rotation or, on a closed domain, an affine map: maps around
            the identity.
        mesh: uv (V, 2), in the common domain, and faces (F, 3) of all surfaces together.
        meshes: the same of each surface, in its own domain.
        diagonals: of each surface's bounding box, the units of the logged errors.
        phis: the surfaces; none is trained.
        names: of the surfaces, each its own, for the curves ``pairs/A_to_B``; None: their numbers.

    Raises:
        ValueError: a constraint that is not known.
    """

    Constraints = CollectionConstraints
    constraints: CollectionConstraints
    quadrature: CollectionQuadrature | None
    ordered: Tensor

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
        starts: Sequence[Rotated | LatticeAligned],
        mesh: tuple[Tensor, Tensor],
        meshes: Sequence[tuple[Tensor, Tensor]],
        diagonals: Sequence[float],
        phis: Sequence[nn.Module],
        loss_terms: dict[str, Any] | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        super().__init__(domain, energy, loss_weights, constraints, max_steps, loss_terms)
        given = ["domain", "energy", "phis", "points", "targets", "seam", "starts", "mesh"]
        self.save_hyperparameters(ignore=[*given, "meshes", "names"], logger=False)
        onto = domain if self.exact else None
        self.map = nn.ModuleList(
            start.around(planar_map(onto, map, activation, encoding)) for start in starts
        )
        self.phis = nn.ModuleList(phi.eval().requires_grad_(False) for phi in phis)
        held = self.constraints
        self.fold_barrier = nn.ModuleList(
            FoldBarrier(*mesh, margin=held.fold_margin, every=held.fold_every) for _ in phis
        )
        start = torch.stack([h.before(points) for h in self.map])  # type: ignore[operator]
        self.set_landmarks(points, targets, start, seam)
        self.folds_of = [Folds(held.injectivity) for _ in phis]
        self.triangles_from = held.triangles_from * max_steps
        if held.triangles_from < 1:
            project = domain.project if domain.has_boundary and self.exact else None
            self.quadrature = CollectionQuadrature(
                meshes, list(self.phis), domain, points, targets, project
            )
        self._turn: Turn | None = None
        self.diagonals = diagonals
        i, j = torch.meshgrid(torch.arange(len(phis)), torch.arange(len(phis)), indexing="ij")
        self.register_buffer("ordered", torch.stack([i[i != j], j[i != j]]), persistent=False)
        names = names or [str(k) for k in range(len(phis))]
        both = zip(*self.ordered.tolist(), strict=True)
        self.pair_names = [f"pairs/{names[a]}_to_{names[b]}" for a, b in both]

    def forward(self, x: Tensor) -> Tensor:
        """Points (N, 2) of the common domain to those of all surfaces, (k, N, 2)."""
        every: Tensor = batched(list(self.map))(x.expand(len(self.map), -1, -1))
        return every

    def training_step(self, batch: Tensor, batch_idx: int) -> Tensor:
        self.batch = batch
        w, ramp = self.loss_weights, self.ramp
        pairs, scale, share = self._scales()
        distortion, evaluation = self._evaluated(batch)
        energy = distortion.mean
        self.distortion = energy.detach()
        # sums over the surfaces
        G = self._folding(evaluation)
        B = 0.0 if self.exact else self._boundary_term(evaluation.image)
        S = self._seam_gap() if len(self.seam) and w.seam > 0 else 0.0
        U = self._triangle_term() if w.triangles > 0 and self._turn is None else 0.0
        C, multipliers = self.landmark_terms()

        loss = pairs * energy + scale * (
            multipliers
            + w.injectivity * G
            + w.boundary * B
            + ramp * w.seam * S
            + w.triangles * U
            + self.landmark_weight * C
        )
        terms: dict[str, Term] = {
            **{name: (pairs * weight, E) for name, (weight, E) in distortion.terms.items()},
            "multipliers": (scale, multipliers),
            "injectivity": (scale * w.injectivity, G),
            "boundary": (scale * w.boundary, B),
            "seam": (scale * ramp * w.seam, S),
            "triangles": (scale * w.triangles, U),
            "landmarks": (scale * self.landmark_weight, C),
        }
        for name, term in self.loss_terms.items():
            terms[name] = (share * term.weight, term(evaluation))
            loss = loss + share * term.weight * terms[name][1]
        self.log_terms(loss, terms, distortion=energy)
        return loss

    def _evaluated(self, x: Tensor) -> tuple[Distortion, Evaluation]:
        """Energy of the ordered pairs at points (N, 2), and what it is made from, of each surface:
        tensors (k, N, ...)."""
        if self.training and self._turn is not None:
            return self._on_triangles(self._turn)
        forms, determinants, images, positions = (
            part.transpose(0, 1) for part in self.pointwise(self._at, x)
        )
        share = self._shares(x, forms.detach(), images.detach())
        i, j = self.ordered
        parts = self.energy.parts(forms[i], forms[j], At(images[i], positions[i]))
        evaluation = Evaluation(images, positions, images, source=forms, determinant=determinants)
        return Distortion(self.energy, parts, share[i]), evaluation

    def _on_triangles(self, turn: Turn) -> tuple[Distortion, Evaluation]:
        """The same of the one map that moves: of its pairs, and tensors (1, F, ...)."""
        some, phi = turn.some, self.phis[turn.number]
        image = self.map[turn.number](some.uv)
        position, centres = phi(image), some.centres_on(image)[None]
        metric = some.forms(position)
        parts = self.energy.parts(*turn.ends(metric), turn.at)
        evaluation = Evaluation(
            centres,
            some.centres_on(position)[None],
            centres,
            source=metric[None],
            determinant=some.relative(image)[None],
            share=some.oriented[None],
        )
        return Distortion(self.energy, parts, turn.share), evaluation

    def _scales(self) -> tuple[int, float, float]:
        """The weights of the mean over the pairs, of the sums over the surfaces, and of means over
        the surfaces.

        In the turn of one map the loss is k/2 times the part that it has in L: its pairs are 2/k of
        all, and their mean has the weight of the mean over all.
        """
        k = len(self.map)
        summed = self.constraints.pairs == "sum"
        pairs, scale = (k * (k - 1), 1.0) if summed else (1, _SURFACES / k)
        return (pairs, scale, 1.0) if self._turn is None else (pairs, k / 2 * scale, 0.5)

    @torch.no_grad()
    def _shares(self, x: Tensor, forms: Tensor, images: Tensor) -> Tensor:
        """How much each sample x (N, 2) counts for each source, (k, N).

        Samples lie by the mean of the surfaces' areas as the maps start: weights make it the area
        of each source as it lies now. Otherwise moving all maps alike, which changes no map between
        surfaces, would lower the mean by taking distorted parts to where few samples are.
        """
        starts = torch.stack([h.before(x) for h in self.map])  # type: ignore[operator]
        outer = batched(list(self.phis)).value_and_jacobian(starts)[1]
        density = determinant(first_fundamental_form(outer)).clamp(min=0).sqrt().mean(dim=0)
        share = determinant(forms).clamp(min=0).sqrt() / density.clamp(min=1e-12)
        if not self.exact:  # samples that a map sends out of Ω do not count
            share = share * inside(self.domain, images).all(dim=0)
        return share

    def turns(self) -> Iterator[nn.Module]:
        """At samples all maps move at once, at triangles one after the other.

        Moving all h_i alike changes no map between surfaces, and a metric that takes each h_i apart
        holds against it. One map alone is that of a pair: the others say where it leads.
        """
        if self.quadrature is None or self.global_step < self.triangles_from:
            yield self.map
            return
        try:
            corners = self.quadrature.corners(self.map)
            for i, h in enumerate(self.map):
                if i:  # the one that moved
                    corners[i - 1] = self.quadrature.taken_back(i - 1, self.map[i - 1])
                self._turn = self.quadrature.turn(i, list(self.map), corners)
                yield h
        finally:
            self._turn = None

    def curvatures(self) -> list[Curvature]:
        if self._turn is not None:
            return self._curvatures_on_triangles(self._turn)
        x, w, k = self.batch, self.loss_weights, len(self.map)
        pairs, scale, _ = self._scales()
        step = self.global_step
        with torch.no_grad():
            images, inner = batched(list(self.map)).value_and_jacobian(x.expand(k, -1, -1))
            positions, outer = batched(list(self.phis)).value_and_jacobian(images)
            forms = first_fundamental_form(outer @ inner)
            share = self._shares(x, forms, images).double()
            share *= pairs / (share.sum(dim=1, keepdim=True).clamp(min=1e-12) * k * (k - 1))

        def energy(i: int, j: Tensor) -> Tensor:
            """The part of the loss at each sample that the map of surface i has."""
            own = first_fundamental_form(outer[i].double() @ j)
            total = scale * w.injectivity / len(x) * self.folds_of[i](determinant(j), step)
            for other in (n for n in range(k) if n != i):
                there, here = At(images[i], positions[i]), At(images[other], positions[other])
                to = self.energy.total(self.energy.parts(own, forms[other], there))
                back = self.energy.total(self.energy.parts(forms[other], own, here))
                total = total + share[i] * to + share[other] * back
            return total

        found = []
        for i, (h, phi) in enumerate(zip(self.map, self.phis, strict=True)):
            found.append(Curvature(h, x, positive_hessians(partial(energy, i), inner[i])))
            found += self.constraint_curvatures(h, phi, self.held[i], scale)
        return found

    def _curvatures_on_triangles(self, turn: Turn) -> list[Curvature]:
        some, i, step = turn.some, turn.number, self.global_step
        h, phi, x = self.map[i], self.phis[i], some.centres
        pairs, scale, _ = self._scales()
        with torch.no_grad():
            image, jacobian = h.value_and_jacobian(x)  # type: ignore[operator]
            outer = phi.value_and_jacobian(image)[1].double()  # type: ignore[operator]
            relative = some.relative(h(some.uv))
            excess = (relative - determinant(jacobian)).double()
        share = pairs * turn.share.double() / turn.share.sum()
        folding = scale * self.loss_weights.injectivity * some.oriented.double()

        def loss(j: Tensor) -> Tensor:
            ends = turn.ends(first_fundamental_form(outer @ j))
            values = share * self.energy.total(self.energy.parts(*ends, turn.at))
            folds = self.folds_of[i](determinant(j) + excess, step, smooth=True)
            return (folding * folds).index_add(0, turn.of, values)

        found = [Curvature(h, x, positive_hessians(loss, jacobian))]
        return found + self.constraint_curvatures(h, phi, self.held[i], scale)

    def _at(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A_i (N, k, 2, 2), det J_h (N, k), h (N, k, 2) and φ∘h (N, k, 3) of all surfaces at points
        (N, 2)."""
        images, inner = batched(list(self.map)).value_and_jacobian(x.expand(len(self.map), -1, -1))
        positions, outer = batched(list(self.phis)).value_and_jacobian(images)
        metrics = first_fundamental_form(outer @ inner)
        parts = metrics, determinant(inner), images, positions
        return tuple(part.transpose(0, 1) for part in parts)  # type: ignore[return-value]

    def _boundary_term(self, images: Tensor) -> Tensor:
        """Σ over surfaces of the mean squared distance of h(∂Ω) to ∂Ω, and of samples outside Ω to
        Ω."""
        stray = outside(self.domain, images).mean(dim=1).sum()
        off = boundary(self.domain, self(self.boundary_samples)).mean(dim=1).sum()
        return off + stray

    def _seam_gap(self) -> Tensor:
        """Σ over surfaces of the mean squared distance between a seam point's two copies."""
        a, b = (
            batched(list(self.phis))(self(self.seam.reshape(-1, 2))).unflatten(1, (-1, 2)).unbind(2)
        )
        return ((a - b) ** 2).sum(dim=-1).mean(dim=1).sum()

    def _folding(self, e: Evaluation) -> Tensor:
        """Σ over surfaces of G at their samples, det J_h (k, N); or that of the map that moves."""
        if e.share is not None and self._turn is not None:
            folds = self.folds_of[self._turn.number]
            return (e.share * folds(e.determinant[0], self.global_step, smooth=True)).sum()
        both = zip(self.folds_of, e.determinant, strict=True)
        return torch.stack([folds(det, self.global_step).mean() for folds, det in both]).sum()

    def _triangle_term(self) -> Tensor:
        barriers: Any = list(self.fold_barrier)
        both = zip(self.map, barriers, strict=True)
        corners = torch.stack([b.corners(h, self.global_step) for h, b in both])
        # the CPU has nothing of a batch
        together = OneByOne if corners.device.type == "cpu" else batched
        images = together(list(self.map))(corners)
        each = zip(barriers, images, strict=True)
        return torch.stack([barrier.of_image(image) for barrier, image in each]).sum()

    def validation_step(self, batch: Tensor, batch_idx: int) -> None:
        distortion, evaluation = self._evaluated(batch)
        self.log_validation(distortion, evaluation)
        of_pairs = dict(zip(self.pair_names, distortion.means.unbind(), strict=True))
        self.log_figures(of_pairs, batch_size=len(batch))

    def flipped_percent(self) -> Tensor:
        both = zip(self.map, self.fold_barrier, strict=True)
        return torch.stack([b.flipped_percent(h) for h, b in both]).mean()  # type: ignore[operator]

    def landmark_error(self) -> Tensor:
        phis = batched(list(self.phis))
        units = self.targets.new_tensor(self.diagonals)[:, None]
        return 100 / units * (phis(self(self.points)) - phis(self.targets)).norm(dim=-1)
