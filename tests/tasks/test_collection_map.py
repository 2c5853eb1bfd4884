"""What task=collection_map minimizes is of the maps between surfaces alone."""

import numpy as np
import pytest
import torch
from rich.console import Console

from nsm.config import compose_config
from nsm.domains import Disc
from nsm.energies.metrics import first_fundamental_form
from nsm.pipeline import built, make_task
from nsm.results import analytic_surface


def areas(module, x):
    """Of each surface per unit of the common domain (k, N), as the maps start."""
    outer = [
        phi.value_and_jacobian(h.before(x))[1]
        for phi, h in zip(module.phis, module.map, strict=True)
    ]
    return torch.linalg.det(first_fundamental_form(torch.stack(outer))).sqrt()


def test_moving_all_maps_alike_leaves_the_distortion_as_it_is():
    names = ("cone", "paraboloid", "sphere_cap")
    shapes = [analytic_surface({"name": name}, Disc()) for name in names]
    task = make_task(compose_config(["task=collection_map", "map.cells=8"]), Console(quiet=True))
    task.use(shapes, [np.zeros(0, dtype=np.int64)] * 3)
    module = built(task).eval()
    torch.testing.assert_close(module.map[1].rotation, torch.eye(2))  # so that "alike" is alike
    generator = torch.Generator().manual_seed(0)
    radius = torch.rand(20_000, generator=generator).sqrt()
    angle = 2 * torch.pi * torch.rand(len(radius), generator=generator)
    x = torch.stack([radius * angle.cos(), radius * angle.sin()], dim=1)
    with torch.no_grad():
        density = areas(module, x).mean(dim=0)
        kept = torch.rand(len(x), generator=generator) < density / density.max()
        x = x[kept]  # samples as those of the training
        before = module._evaluated(x)[0].means
        for h in module.map:
            for p in h.parameters():
                p.add_(0.5 * torch.linspace(-1, 1, len(p)).square()[:, None])
        after = module._evaluated(x)[0].means
        determinant = torch.linalg.det(module.map[0].value_and_jacobian(x)[1])
    assert 0 < determinant.min() < 0.6 and determinant.max() > 1.4
    assert after.tolist() == pytest.approx(before.tolist(), abs=1e-3)
