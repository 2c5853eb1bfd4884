"""Param: closed forms, libigl on the same mesh, and the command."""

import json

import ezdxf
import numpy as np
import pytest
import torch
import trimesh
from torch import nn

import nsm
from nsm.data import SurfaceSampler
from nsm.domains import Square, Surface
from nsm.domains.baselines import BASELINES
from nsm.energies import SymmetricDirichlet
from nsm.errors import NsmError
from nsm.results import planar_metrics
from nsm.surfaces import shapes
from nsm.surfaces.catalogue import catalogue_mesh
from nsm.surfaces.topology import face_areas
from nsm.tasks import Param

SETTINGS = {
    "map": {
        "width": 16,
        "depth": 1,
        "block": "plain",
    },
    "activation": {"_target_": "nsm.maps.activations.Softplus", "beta": 10.0},
    "encoding": {"_target_": "nsm.maps.encodings.Identity"},
    "optimizer": {"_target_": "torch.optim.Adam", "lr": 1e-2},
    "scheduler": {"_target_": "nsm.tasks.schedules.Cosine"},
    "max_steps": 300,
    "domain": Square(),
    "energy": SymmetricDirichlet(),
    "loss_weights": {"injectivity": 100.0, "triangles": 100.0},
    "constraints": {"boundary": "free"},
}


class Stretched(nn.Module):
    """The plane stretched by 2 and 1/2: an isometry undoes it."""

    def __init__(self, s=2.0, t=0.5):
        super().__init__()
        frame = torch.tensor([[s, 0.0], [0.0, t], [0.0, 0.0]])
        self.register_buffer("frame", frame)

    def value_and_jacobian(self, x):
        return x @ self.frame.T, self.frame.expand(len(x), 3, 2)


@pytest.fixture(scope="module")
def plane() -> Surface:
    return Surface.from_arrays(*catalogue_mesh("plane"), domain="square")


def mesh_of(surface):
    uv = torch.as_tensor(surface.uv, dtype=torch.float32)
    areas = torch.as_tensor(face_areas(surface.vertices, surface.faces), dtype=torch.float32)
    return uv, torch.as_tensor(surface.faces), areas


def param(surface, phi, **changes):
    torch.manual_seed(0)
    module = Param(**{**SETTINGS, **changes}, mesh=mesh_of(surface), phi=phi)
    module.log_every = 10**9  # there is no logger
    return module


def train(module, surface, steps):
    sampler = SurfaceSampler(surface)
    chosen = module.configure_optimizers()
    for step in range(steps):
        batch = sampler.by_area(512, sampler.generator(0, step))
        loss = module.training_step(batch, step)
        chosen["optimizer"].zero_grad()
        loss.backward()
        chosen["optimizer"].step()
        chosen["lr_scheduler"]["scheduler"].step()
    return float(loss)


def test_an_isometry_is_the_minimum(plane):
    module = param(plane, Stretched(1.0, 1.0))
    sampler = SurfaceSampler(plane)
    loss = module.training_step(sampler.by_area(100, sampler.generator(0)), 0)
    assert loss.item() == pytest.approx(2 + 2 / 1.01, rel=1e-5)


def test_a_stretch_is_undone(plane):
    module = param(plane, Stretched())
    loss = train(module, plane, 300)
    assert loss == pytest.approx(2 + 2 / 1.01, rel=1e-2)
    jacobian = module.map.value_and_jacobian(torch.rand(100, 2) - 0.5)[1]
    sigma = torch.linalg.svdvals(jacobian @ torch.diag(torch.tensor([0.5, 2.0])))
    assert float((sigma - 1).abs().max()) < 0.1
    assert float(torch.linalg.det(jacobian).min()) > 0


def test_a_fixed_boundary_stays_on_that_of_the_domain(plane):
    module = param(plane, Stretched(), constraints={"boundary": "fixed"})
    train(module, plane, 100)
    edge = torch.as_tensor(plane.uv[np.abs(plane.uv).max(axis=1) == 1], dtype=torch.float32)
    assert float((module.map(edge).abs().amax(dim=1) - 1).abs().max()) < 1e-6


def test_a_boundary_that_is_not_known_is_refused(plane):
    with pytest.raises(ValueError):
        param(plane, Stretched(), constraints={"boundary": "loose"})


def test_planar_figures_of_known_maps():
    vertices, faces = catalogue_mesh("plane")
    flat = vertices[:, :2]
    same = planar_metrics(vertices, faces, flat)
    assert same["symmetric_dirichlet_median"] == pytest.approx(2 + 2 / 1.01)
    assert same["flipped_percent"] == 0
    assert same["boundary_self_intersections"] == 0
    assert same["conformal_median"] == pytest.approx(0, abs=1e-9)
    stretched = planar_metrics(vertices, faces, flat * [3.0, 1.0])
    # Eq. 3 at σ = 3 and 1: ‖(10/82) diag(9, 1) - I‖²
    expected = (10 * 9 / 82 - 1) ** 2 + (10 / 82 - 1) ** 2
    assert stretched["conformal_median"] == pytest.approx(expected)
    assert stretched["singular_value_ratio_p95"] == pytest.approx(3)
    assert stretched["area_mean"] == pytest.approx(4 + 4 / 9)
    folded = flat.copy()
    middle = int(np.linalg.norm(flat, axis=1).argmin())
    folded[middle] += 0.2
    assert planar_metrics(vertices, faces, folded)["flipped_percent"] > 0
    mirrored = planar_metrics(vertices, faces, flat * [-1.0, 1.0])
    assert mirrored["flipped_percent"] == 0


@pytest.mark.parametrize("name", ["SLIM", "ARAP", "LSCM"])
def test_libigl_flattens_a_bent_sheet_isometrically(name):
    vertices, faces = catalogue_mesh("plane")
    x, y = vertices[:, 0], vertices[:, 1]
    bent = np.stack([np.sin(x), y, np.cos(x)], axis=1)  # part of a cylinder
    uv = BASELINES[name](bent, faces, vertices[:, :2] * 0.8)
    figures = planar_metrics(bent, faces, uv)
    assert figures["symmetric_dirichlet_median"] == pytest.approx(2 + 2 / 1.01, rel=2e-3)
    assert figures["flipped_percent"] == 0


HEMISPHERE = shapes.hemisphere(10)
LITTLE = ["data.batch_size=512", "data.held_out=512"]
OF_PHI = ["data.steps_per_epoch=50", "encoding.resolutions=[4,16]", "trainer.max_steps=100"]


@pytest.fixture(scope="module")
def phi() -> nsm.NeuralSurface:
    # from Tutte's embedding, as SLIM on the disc leaves hardly anything to lower
    surface = Surface.from_arrays(*HEMISPHERE, name="hemisphere", parameterization="tutte")
    overrides = ["experiment=quick", *LITTLE, *OF_PHI]
    return nsm.overfit(surface, overrides=overrides, progress=False)


QUICK = [*LITTLE, "map.cells=32", "optimizer.levels=[8,32]", "optimizer.steps=[2]"]


def test_parameterize_lowers_distortion_and_is_given_back(phi, tmp_path):
    overrides = [*QUICK, "baselines=true"]
    flat = nsm.parameterize(phi, overrides=overrides, folder=tmp_path, progress=False)
    ours, start = flat.metrics["nsm"], flat.metrics["domain"]
    assert ours["symmetric_dirichlet_mean"] < start["symmetric_dirichlet_mean"]
    assert ours["flipped_percent"] == 0
    assert ours["symmetric_dirichlet_median"] < (
        1.05 * flat.metrics["SLIM (libigl)"]["symmetric_dirichlet_median"]
    )
    for name in ("parameterized.obj", "parameterized.glb", "checkerboard.png", "map.safetensors"):
        assert (tmp_path / name).stat().st_size > 0
    # the pattern is in file units: half a unit sphere has the area 2π, and Ω has π
    (outline,) = ezdxf.readfile(tmp_path / "pattern.dxf").modelspace().query("LWPOLYLINE")
    x, y = np.array(outline.get_points("xy")).T
    assert 0.9 < 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / (2 * np.pi) < 1.2
    stored = json.loads((tmp_path / "metrics.json").read_text())
    assert stored["metrics"] == flat.metrics
    again = nsm.load(tmp_path)
    assert np.array_equal(again.uv, flat.uv)
    assert again.metrics == flat.metrics
    (tmp_path / "map.safetensors").write_bytes(b"short")
    with pytest.raises(NsmError) as error:
        nsm.load(tmp_path)
    assert error.value.kind == "damaged_file"


def test_the_command_makes_and_keeps_the_neural_surface(tmp_path, here):
    vertices, faces = HEMISPHERE
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "hemisphere.obj")
    words = ["task=param", "surface.path=hemisphere.obj", *LITTLE, "trainer.max_steps=2"]
    words += ["logger=none", "artefacts=false"]
    few = 'phi.overrides=["experiment=quick","data.held_out=512","trainer.max_steps=2"]'
    for attempt in ("made", "cached"):
        result = here(*words, few)
        assert result.returncode == 0, result.stderr
        assert ("neural surface taken from the cache" in result.stdout) == (attempt == "cached")
        assert "SLIM (libigl)" not in result.stdout  # only baselines=true computes them
    result = here(*words, "phi.path=nowhere")
    assert (result.returncode, len(result.stderr.strip().splitlines())) == (2, 1)


def test_the_bijective_mode_covers_the_domain_once(phi):
    words = [*QUICK, "constraints.boundary=fixed"]
    flat = nsm.parameterize(phi, overrides=words, progress=False)
    figures = flat.metrics["nsm"]
    assert figures["flipped_percent"] == 0 and figures["boundary_self_intersections"] == 0
    assert np.linalg.norm(flat.uv, axis=1).max() < 1 + 1e-6
