"""Maps of a collection where one of them folds beside a landmark."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from torch import nn

from nsm.domains import domain
from nsm.results import SurfaceCollection

OFF = 0.05  # where the folded map has the landmark
ROOT = brentq(lambda x: x + 0.15 * np.sin(40 * x), 0.07, 0.11)  # leads there as well


class Moved(nn.Module):
    """(x, y) to (x + shift + height sin(40 x), y)."""

    inner = None

    def __init__(self, shift: float, height: float) -> None:
        super().__init__()
        self.shift, self.height = shift, height

    def back(self, x: torch.Tensor) -> torch.Tensor:
        return x

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        wave = self.height * torch.sin(40 * x[:, 0])
        return torch.stack([x[:, 0] + self.shift + wave, x[:, 1]], dim=1)

    def value_and_jacobian(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        slope = 1 + 40 * self.height * torch.cos(40 * x[:, 0])
        return self(x), torch.stack(
            [torch.stack([slope, 0 * slope], 1), torch.eye(2)[1].expand(len(x), 2)], 1
        )


def flat(*landmark: float) -> SimpleNamespace:
    """Points of the unit disc: a landmark, one at the other root, and some around."""
    uv = np.array([landmark, (ROOT, 0.0), (0.5, 0.5), (-0.5, 0.5), (0.0, -0.7)])
    ids = np.arange(len(uv))
    surface = SimpleNamespace(
        uv=uv, domain=domain("disc"), cut_vertex=ids, source_vertex=ids, kept=np.asarray
    )
    return SimpleNamespace(surface=surface)


def test_the_common_point_of_a_landmark_is_taken_back() -> None:
    """Two maps have it at 0, but for what a training leaves; the third one folds there."""
    surfaces = [flat(OFF, 0.0), flat(0.001, 0.0), flat(0.001, 0.0)]
    maps = [Moved(OFF, 0.15), Moved(0.0, 0.0), Moved(0.0, 0.0)]
    folded = maps[0](torch.tensor([[0.0, 0.0], [ROOT, 0.0]], dtype=torch.float64))
    assert folded[:, 0].tolist() == pytest.approx([OFF, OFF])
    group = SurfaceCollection(surfaces, maps, np.array([[0, 0, 0]]))  # type: ignore[arg-type]
    back = group._preimages(0)
    assert back[0] == pytest.approx([0.0, 0.0], abs=1e-9)
    # alone, the map is taken back to the vertex whose image is nearest
    assert group._pulled_back(0, surfaces[0].surface.uv)[0] == pytest.approx([ROOT, 0], abs=1e-9)
    assert group._preimages(1)[0] == pytest.approx([0.001, 0.0])
