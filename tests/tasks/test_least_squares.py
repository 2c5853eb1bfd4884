"""The least-squares start: exact on what the features span."""

import numpy as np
import pytest
import torch
from rich.console import Console

from nsm.config import compose_config
from nsm.domains import Surface
from nsm.domains.surface import as_it_lies
from nsm.errors import NsmError
from nsm.maps import LatticeSplineGrid
from nsm.maps.encodings import SplineGrid, value_and_jacobian_stack
from nsm.maps.networks import build_network
from nsm.pipeline import built, make_task
from nsm.results import pointwise_metrics
from nsm.tasks.least_squares import _SMOOTH, _fit_tables, _on_lattice, fit_linear_skip
from nsm.tasks.multigrid import folding
from nsm.tasks.planar import planar_map

GRID = {"_target_": "nsm.maps.encodings.SplineGrid", "resolutions": [4, 8], "features": 3}
FOURIER = {"_target_": "nsm.maps.encodings.RandomFourierFeatures", "features": 4}
MATRIX = np.array([[1.0, 0.3], [-0.2, 0.8], [0.5, 0.1]])


def sheet(height) -> Surface:
    """The square [-1, 1]² itself, carried to space by MATRIX and a height."""
    line = np.linspace(-1, 1, 41)
    uv = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    a = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    faces = np.concatenate([np.stack([a, a + 41, a + 42], 1), np.stack([a, a + 42, a + 1], 1)])
    vertices = uv @ MATRIX.T
    vertices[:, 2] += height(*uv.T)
    return as_it_lies("sheet", vertices, faces, uv, "square")


def network_of(encoding):
    return build_network(
        map={"_target_": "nsm.maps.NeuralMap", "width": 8, "depth": 1, "linear_skip": "fitted"},
        activation={"_target_": "nsm.maps.activations.Softplus"},
        encoding=encoding,
        out_dim=3,
    )


def overfit_module(surface, *words):
    task = make_task(compose_config([*words]), Console())
    task.use(surface)
    return built(task)


@pytest.mark.parametrize("encoding", [GRID, FOURIER, {"_target_": "nsm.maps.encodings.Identity"}])
def test_a_plane_is_met_exactly(encoding):
    """Affine functions are in the span of every encoding."""
    network = network_of(encoding)
    flat = sheet(lambda u, v: 0 * u + 2)
    fit_linear_skip(network, flat)
    uv = torch.rand(200, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1
    value, jacobian = network.value_and_jacobian(uv)
    expected = uv @ torch.tensor(MATRIX.T, dtype=torch.float32) + torch.tensor([0.0, 0.0, 2.0])
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-4)
    wanted = torch.tensor(MATRIX, dtype=torch.float32).expand_as(jacobian)
    torch.testing.assert_close(jacobian, wanted, rtol=0, atol=1e-3)


def test_a_spline_of_the_grid_is_found_again(monkeypatch):
    monkeypatch.setattr("nsm.tasks.least_squares._SMOOTH", 1e-6)  # it is as rough as can be
    torch.manual_seed(0)
    grid, found = SplineGrid(2, [4, 8], 3), SplineGrid(2, [4, 8], 3)
    linear_skip = torch.nn.Linear(grid.out_dim, 3)
    with torch.no_grad():
        for table in grid.tables:
            table.normal_()
        uv = 2 * torch.rand(4000, 2) - 1
        along = torch.eye(2, dtype=torch.float64)[..., None].expand(2, 2, len(uv))

        def spline(stack):  # each level adds to the same three coordinates
            return stack[:, :, 2:5] + stack[:, :, 5:8]

        target = spline(value_and_jacobian_stack(grid, uv)).double()
        _fit_tables(found, linear_skip, uv, along, target.transpose(1, 2))
        stack = value_and_jacobian_stack(found, uv) @ linear_skip.weight.t()
        stack[0] += linear_skip.bias
    torch.testing.assert_close(stack, target.float(), rtol=0, atol=5e-3)


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("cells", [(4, 4), (6, 8)])
def test_the_system_of_a_closed_domain_is_that_of_all_samples_written_out(cells, even):
    """Dense: each sample's row, and second differences around the whole period."""
    grid = LatticeSplineGrid([cells], 3, even)
    random = torch.Generator().manual_seed(0)
    uv = 4 * torch.rand(300, 2, generator=random) - 2
    along = torch.randn(2, 2, len(uv), generator=random)
    target = torch.randn(3, 3, len(uv), generator=random)
    matrix, right = _on_lattice(grid, 0, uv.t(), along, target)

    rows, weights = grid.seen(uv, 0)
    slopes = torch.einsum("knt,kjn->jnt", weights[1:], along)  # along two directions
    design = torch.zeros(3, len(uv), len(grid.tables[0]))
    for order, value in enumerate((weights[0], *slopes)):
        design[order].scatter_add_(1, rows, value)
    design = design.flatten(0, 1).double()
    expected = (design.t() @ design).numpy()
    n, m = cells
    fold = folding(grid, n, m).toarray().reshape(n, m, -1)
    for axis in (0, 1):
        bend = np.roll(fold, 1, axis) - 2 * fold + np.roll(fold, -1, axis)
        bend = bend.reshape(n * m, -1)
        share = len(expected) / (n * m)
        weight = _SMOOTH * np.diag((design.t() @ design).numpy()).mean()
        expected = expected + weight * share * bend.T @ bend
    wanted = design.t() @ target.transpose(1, 2).flatten(0, 1).double()
    np.testing.assert_allclose(matrix.toarray(), expected, rtol=1e-4, atol=1e-4 * weight)
    np.testing.assert_allclose(right, wanted.numpy(), rtol=1e-4, atol=1e-3)


def test_a_curved_surface_is_met_before_any_training():
    wave = sheet(lambda u, v: 0.2 * np.sin(2 * u) * np.cos(v))
    words = ["domain=square", "encoding.resolutions=[8,32]", "seed=3"]
    fitted, plain = (
        pointwise_metrics(wave, overfit_module(wave, *words, f"map.linear_skip={r}").map)
        for r in ("fitted", "linear")
    )
    assert fitted["rms_percent"] < 0.02 < 5 < plain["rms_percent"]
    assert fitted["normal_error_mean_degrees"] < 1


def test_the_boundary_is_met_the_better_for_samples_on_it(monkeypatch):
    """There both sides of a seam have to meet. The waves are too short for the grid."""
    rough = sheet(lambda u, v: 0.1 * np.sin(9 * u) * np.sin(9 * v))
    on_boundary = np.abs(rough.uv).max(axis=1) == 1
    uv = torch.as_tensor(rough.uv[on_boundary], dtype=torch.float32)
    wanted = torch.as_tensor(rough.vertices[on_boundary], dtype=torch.float32)
    errors = []
    for every in (33, 10**9):
        monkeypatch.setattr("nsm.tasks.least_squares._BOUNDARY_EVERY", every)
        encoding = {**GRID, "resolutions": [8]}
        network = network_of(encoding)
        fit_linear_skip(network, rough)
        with torch.no_grad():
            errors.append(float((network(uv) - wanted).square().sum(dim=1).mean().sqrt()))
    assert errors[0] < 0.95 * errors[1]


def test_too_few_features_are_refused():
    words = ["map.linear_skip=fitted", "encoding.features=2", "domain=square"]
    with pytest.raises(NsmError):
        overfit_module(sheet(lambda u, v: 0 * u), *words)


def test_maps_of_the_plane_have_nothing_to_fit():
    settings = compose_config(["task=param", "experiment=adam", "map.linear_skip=fitted"])
    with pytest.raises(NsmError) as error:
        planar_map(None, settings.map, settings.activation, settings.encoding)
    assert error.value.key == "map.linear_skip"
