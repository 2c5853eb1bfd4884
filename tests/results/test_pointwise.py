"""Maps on tensors, composed, and as correspondences: on domes over the disc, without training."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from tensor_checks import (
    check_composition,
    check_correspondences,
    check_tensors,
    check_weights,
    points_on,
)
from tiny import planar, results

import nsm
from nsm.errors import NsmError
from nsm.maps import Placed, Rotated
from nsm.pipeline.resolve_inputs import read_shape
from nsm.results import SurfaceMap, analytic_surface
from nsm.results.file_faces import same_mesh

NEURAL, _, PAIR, TRIO = results(rings=6)
ANALYTIC = SurfaceMap(
    NEURAL[0],
    analytic_surface({"name": "saddle"}, "disc"),
    Rotated(planar(), torch.eye(2)),
    np.zeros((0, 2), dtype=int),
)


@pytest.mark.parametrize(
    "f", [PAIR, TRIO.pair(2, 0), ANALYTIC], ids=["pair", "of three", "analytic"]
)
def test_maps_of_the_disc(f):
    check_tensors(f)
    check_weights(f)
    check_correspondences(f)


def test_maps_compose_if_they_meet():
    check_composition(TRIO.pair(1, 2), PAIR)
    with pytest.raises(NsmError) as caught:
        PAIR @ PAIR
    assert caught.value.kind == "wrong_mesh"
    loop = TRIO.pair(2, 0) @ TRIO.pair(1, 2) @ TRIO.pair(0, 1)
    assert len(loop.maps) == 3
    p = points_on(PAIR)
    assert np.abs(loop(p) - p).max() < 0.02  # h_i close; linear pieces do so approximately


def test_a_module_trains_a_copy_of_the_weights():
    p = torch.as_tensor(points_on(PAIR))
    before, module = PAIR(p), PAIR.module().requires_grad_(True)
    wanted = before + 0.02
    optimizer = torch.optim.Adam(module.parameters(), lr=1e-2)
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        loss = (module(p) - wanted).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]
    assert torch.equal(PAIR(p), before)
    trained = module.surface_map()
    torch.testing.assert_close(trained(p), module(p), atol=1e-6, rtol=1e-5)
    assert not any(w.requires_grad for w in trained.map.parameters())


def test_neural_surfaces_are_modules_in_units_of_the_file():
    phi = NEURAL[1]
    uv = torch.rand(10, 2, generator=torch.Generator().manual_seed(0))
    module = phi.module()
    assert isinstance(module, Placed)
    assert torch.equal(module(uv), phi(uv))
    value, jacobian = module.value_and_jacobian(uv)
    torch.testing.assert_close(jacobian, phi.jacobian(uv))
    module.requires_grad_(True)(uv).sum().backward()
    assert all(p.grad is not None for p in module.parameters())
    assert not any(p.requires_grad for p in phi.map.parameters())
    s = phi.surface
    normalised = phi.map(uv).detach().double() / s.scale + torch.as_tensor(s.center)
    torch.testing.assert_close(value.detach().double(), normalised, atol=1e-6, rtol=1e-6)


def test_the_mesh_of_the_file_is_kept(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    order = np.random.default_rng(0).permutation(len(faces))
    given = 7.0 * vertices + 3.0, np.roll(faces[order], 1, axis=1)
    surface = nsm.Surface.from_arrays(*given)
    phi = nsm.NeuralSurface(surface, NEURAL[0].map)
    phi.save(tmp_path)
    for one in (phi, nsm.load(tmp_path)):
        for array, expected in zip(one.file_mesh(), given, strict=True):
            assert np.array_equal(array, expected)
    # what a run left is prepared again as the mesh was
    shape = read_shape(nsm.load(tmp_path).surface, surface.domain, "source")
    assert np.array_equal(shape.vertices, given[0]) and np.array_equal(shape.faces, given[1])
    with pytest.raises(NsmError) as caught:
        read_shape(replace(surface, raw=None), surface.domain, "source")
    assert caught.value.kind == "wrong_type" and caught.value.key == "source"
    # an older version's surface has the faces in another order
    older = nsm.NeuralSurface(replace(surface, raw=None), NEURAL[0].map)
    vertices, faces = older.file_mesh()
    np.testing.assert_allclose(vertices, given[0], atol=1e-12)
    rows = [np.sort(np.sort(f, axis=1), axis=0).tolist() for f in (faces, given[1])]
    assert rows[0] == rows[1]
    assert same_mesh(older, phi) and not same_mesh(older, NEURAL[0])
