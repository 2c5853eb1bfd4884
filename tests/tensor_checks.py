"""What every map between surfaces does with tensors, checked against differences of its values."""

from __future__ import annotations

import numpy as np
import torch

from nsm.errors import NsmError
from nsm.results import SurfaceMap


def points_on(f: SurfaceMap, count: int = 40, seed: int = 0) -> np.ndarray:
    """Random points (N, 3) of the source, in the units of its file, away from edges."""
    random = np.random.default_rng(seed)
    vertices, faces = f.source.file_mesh()
    face = random.integers(0, len(faces), count)
    weights = random.dirichlet(np.full(3, 8.0), count)
    return np.einsum("nk,nkd->nd", weights, vertices[faces[face]])


def check_tensors(f: SurfaceMap) -> None:
    """Values, derivatives and inverses of a map on tensors are those of arrays."""
    p = points_on(f)
    x = torch.tensor(p, requires_grad=True)
    y = f(x)
    size = np.ptp(f.target.file_mesh()[0], axis=0).max()
    assert y.dtype == x.dtype
    np.testing.assert_allclose(y.detach().numpy(), f(p), atol=1e-9 * size)
    assert f(x.float()).dtype == torch.float32
    value, jacobian = f.value_and_jacobian(p)
    np.testing.assert_allclose(value, f(p), atol=1e-9 * size)
    eps = 1e-6 * np.ptp(p, axis=0).max()
    steps = eps * np.eye(3)
    slopes = np.stack([(f(p + e) - f(p - e)) / (2 * eps) for e in steps], axis=2)
    off = np.abs(slopes - jacobian).max(axis=(1, 2)) / np.abs(jacobian).max(axis=(1, 2))
    assert np.mean(off < 1e-4) > 0.9  # the others are where two pieces meet
    (gradient,) = torch.autograd.grad(y.sum(), x)
    np.testing.assert_allclose(gradient.numpy(), jacobian.sum(axis=1), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(f.inverse(y).detach().numpy(), f.inverse(f(p)), atol=1e-8 * size)
    check_planar(f)


def check_planar(f: SurfaceMap) -> None:
    """The same of the map between the domains, in other lifts of a closed domain too."""
    s = f.source.surface
    uv = s.uv[s.faces].mean(axis=1)
    if not s.domain.has_boundary:
        uv = np.concatenate([uv, 2 - uv, uv + [2, -4]])
    x = torch.tensor(uv, requires_grad=True)
    y = f.planar(x)
    np.testing.assert_allclose(y.detach().numpy(), f.planar(uv), atol=1e-9)
    eps = 1e-7
    for k in range(2):
        (gradient,) = torch.autograd.grad(y[:, k].sum(), x, retain_graph=True)
        ways = eps * np.eye(2)
        slopes = np.stack([(f.planar(uv + e) - f.planar(uv - e))[:, k] for e in ways], axis=1)
        np.testing.assert_allclose(gradient.numpy(), slopes / (2 * eps), rtol=1e-4, atol=1e-4)


def check_weights(f: SurfaceMap) -> None:
    """A module has the values of its map, and derivatives by the weights of h."""
    x = torch.as_tensor(points_on(f, 20))
    module = f.module().double()
    np.testing.assert_allclose(module(x).numpy(), f(x.numpy()), rtol=1e-6, atol=1e-6)
    assert not any(p.requires_grad for p in module.parameters())
    module.requires_grad_(True)
    module.value_and_jacobian(x)[1].square().sum().backward()
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in module.parameters())
    module.zero_grad()
    before = module(x)
    before.square().sum().backward()
    parameters = [p for p in module.parameters() if p.grad is not None and p.grad.abs().max() > 0]
    eps = 1e-6
    for weight in (parameters[0], parameters[-1]):
        at = int(weight.grad.abs().argmax())
        totals = []
        for sign in (1, -1):
            with torch.no_grad():
                weight.view(-1)[at] += sign * eps
                totals.append(module(x).square().sum().item())
                weight.view(-1)[at] -= sign * eps
        slope = (totals[0] - totals[1]) / (2 * eps)
        assert abs(weight.grad.view(-1)[at].item() - slope) < 1e-3 * abs(slope) + 1e-6
    assert torch.allclose(module(x), before)


def check_correspondences(f: SurfaceMap) -> None:
    """Places of the vertices of both files, on the faces of the other."""
    vertices, faces = f.target.file_mesh()
    given = f.source.file_mesh()[0]
    face, weights = f.correspondences()
    size = np.ptp(vertices, axis=0).max()
    assert face.shape == (len(given),) and weights.shape == (len(given), 3)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    image = np.einsum("nk,nkd->nd", weights, vertices[faces[face]])
    welded = f.target.in_original_units(f.welded_image)
    np.testing.assert_allclose(image, welded, atol=1e-6 * size)
    s = f.source.surface
    once = np.setdiff1d(np.arange(len(given)), s.source_vertex[s.seam_pairs.ravel()])
    np.testing.assert_allclose(image[once], f(given[once]), atol=1e-6 * size)
    back = f.correspondences(back=True)
    origin = back.take(*f.source.file_mesh())
    t = f.target.surface
    once = np.setdiff1d(np.arange(len(vertices)), t.source_vertex[t.seam_pairs.ravel()])
    apart = np.linalg.norm(origin - f.inverse(vertices), axis=1)[once]
    assert np.quantile(apart, 0.99) < 1e-6 * np.ptp(given, axis=0).max()


def check_composition(g: SurfaceMap, f: SurfaceMap) -> None:
    """``g @ f`` is f followed by g, on arrays, tensors and vertices."""
    both, p = g @ f, points_on(f)
    assert both.source is f.source and both.target is g.target
    np.testing.assert_array_equal(both(p), g(f(p)))
    value, jacobian = both.value_and_jacobian(p)
    np.testing.assert_allclose(jacobian, g.value_and_jacobian(f(p))[1] @ f.value_and_jacobian(p)[1])
    np.testing.assert_allclose(value, both(p), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(both.inverse(value), f.inverse(g.inverse(value)))
    x = torch.as_tensor(p)
    np.testing.assert_allclose(both.module()(x).numpy(), both(x).numpy(), rtol=1e-6, atol=1e-6)
    back = both.module().inverse(torch.as_tensor(value))
    np.testing.assert_allclose(back.numpy(), both.inverse(value), rtol=1e-6, atol=1e-6)
    other = both.module().value_and_jacobian(x)[1].numpy()
    np.testing.assert_allclose(other, jacobian, rtol=1e-4, atol=1e-4)
    there = both.correspondences().take(*g.target.file_mesh())
    start = f.correspondences().take(*f.target.file_mesh())
    off = np.linalg.norm(there - g(start), axis=1)
    assert np.quantile(off, 0.9) < 1e-6 * np.ptp(there, axis=0).max()
    rows = np.asarray(both.matrix().sum(axis=1)).ravel()
    np.testing.assert_allclose(rows, 1)
    try:
        f @ g @ f
    except NsmError as error:
        assert error.kind == "wrong_mesh"
