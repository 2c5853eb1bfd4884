"""What holds the caps of a part in a map into a whole shape: nearly nothing, but no folds."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from nsm.energies import first_fundamental_form
from nsm.energies.metrics import determinant
from nsm.tasks.curvature import Curvature, positive_hessians
from nsm.tasks.fold_barrier import Folds
from nsm.tasks.mesh_quadrature import MeshQuadrature

# of the logarithm of 1 + the distortion, beside the distortion of the part
_WEIGHT = 0.01


class Caps(nn.Module):
    """A small weight times the mean logarithm of one plus the distortion over the caps' triangles,
    and how much they fold.

    A cap takes the rest of the target, whatever its shape: its distortion says nothing. Without
    any term, h could fold there. By the logarithm, a cap that must be stretched much draws little
    on the part.

    Args:
        uv: (V, 2) vertices of the source in Ω.
        faces: (C, 3) of the caps.
        surface: φ.
        injectivity: as for :class:`nsm.tasks.fold_barrier.Folds`.
    """

    def __init__(self, uv: Tensor, faces: Tensor, surface: nn.Module, injectivity: str) -> None:
        super().__init__()
        self.quadrature = MeshQuadrature(uv, faces, surface)
        self.folds = Folds(injectivity)

    def forward(self, h: Any, psi: Any, energy: Any, folding: float, step: int) -> Tensor:
        """The term: a scalar.

        Args:
            h, psi: the planar map and the target.
            energy: of the metrics A and B, a blend.
            folding: weight of the folds.
            step: of the training.
        """
        some = self.quadrature.take()
        image = h(some.uv)
        B = some.forms(psi(image))
        relative = some.relative(image)
        values = energy.total(energy.parts(some.metric, B, some.at))
        folds = self.folds(relative, step)
        share = some.share
        return (share * (_WEIGHT * values.clamp(min=0).log1p() + folding * folds)).sum()

    def curvature(self, h: Any, psi: Any, energy: Any, folding: float, step: int) -> Curvature:
        """The second derivatives of the term by J_h; arguments as for :meth:`forward`."""
        some = self.quadrature.take()
        at = some.at
        with torch.no_grad():
            phi = self.quadrature.surface
            source = first_fundamental_form(phi.value_and_jacobian(some.centres)[1])
            image, jacobian = h.value_and_jacobian(some.centres)
            outer = psi.value_and_jacobian(image)[1].double()

        def term(j: Tensor) -> Tensor:
            target = first_fundamental_form(outer @ j)
            values = energy.total(energy.parts(source, target, at))
            folds = self.folds(determinant(j), step)
            return _WEIGHT * values.clamp(min=0).log1p() + folding * folds

        hessians = some.share.double()[:, None, None] * positive_hessians(term, jacobian)
        return Curvature(h, some.centres, hessians)
