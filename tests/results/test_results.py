"""Figures against closed forms, artefacts against damage, exports and pictures read back."""

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from tiny import dome, results
from torch import nn

from nsm.config import compose_config
from nsm.domains import Surface, domain
from nsm.domains.surface import as_it_lies
from nsm.errors import NsmError
from nsm.maps import NeuralMap
from nsm.maps.encodings import RandomFourierFeatures
from nsm.pipeline import runner
from nsm.pipeline.task import Task
from nsm.results import (
    NeuralSurface,
    atomic_write,
    checkerboard,
    checkerboard_picture,
    collection_metrics,
    error_picture,
    export_mesh,
    figures_picture,
    load_collection,
    load_surface,
    overfit_metrics,
    reconstruction_image,
    save_surface,
)
from nsm.results.collection_pictures import cycle_picture
from nsm.results.evolution import extend_strip
from nsm.results.files import as_json
from nsm.results.landmark_picture import landmarks_picture
from nsm.results.pair_pictures import normals_picture
from nsm.results.pictures import neural_normals, normals_at_vertices
from nsm.results.rasteriser import rasterise
from nsm.results.render import UP_AXES, View, vertex_normals
from nsm.results.spheres import Spheres
from nsm.surfaces.shapes import ring_mesh


class Affine(nn.Module):
    """(u, v) to offset + u a + v b: a surface whose distances to a plane are known."""

    def __init__(self, a, b, offset):
        super().__init__()
        frame = np.stack([a, b], axis=1)
        self.frame = nn.Parameter(torch.tensor(frame, dtype=torch.float64))
        self.offset = nn.Parameter(torch.tensor(offset, dtype=torch.float64))

    def forward(self, uv):
        return uv @ self.frame.T + self.offset

    def value_and_jacobian(self, uv):
        return self(uv), self.frame.expand(len(uv), 3, 2)


def square(seam_pairs=()) -> Surface:
    """[-1, 1]² in the plane z = 0, with its own coordinates as uv."""
    n = 6
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    uv = np.stack([x.ravel(), y.ravel()], axis=1)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    origin = np.arange(len(uv))
    for first, copy in seam_pairs:
        origin[copy] = first
    vertices = np.column_stack([uv, np.zeros(len(uv))])
    return as_it_lies("square", vertices, faces, uv, "square", origin=origin)


DIAGONAL = np.sqrt(8)


def test_a_perfect_map_has_no_error():
    figures = overfit_metrics(square(), Affine([1, 0, 0], [0, 1, 0], [0, 0, 0]), samples=2000)
    assert all(value == pytest.approx(0, abs=1e-6) for value in figures.values())


def test_a_shift_is_measured_exactly():
    figures = overfit_metrics(square(), Affine([1, 0, 0], [0, 1, 0], [0, 0, 0.1]), samples=2000)
    for key in (
        "rms_percent",
        "max_percent",
        "hausdorff_mesh_to_phi_percent",
        "hausdorff_phi_to_mesh_percent",
    ):
        assert figures[key] == pytest.approx(10 / DIAGONAL, rel=1e-6), key
    assert figures["normal_error_mean_degrees"] == pytest.approx(0, abs=1e-5)


def test_rms_of_a_stretch_is_the_closed_form():
    # φ = (1.1 u, v, 0): squared distance 0.01 u², whose mean over the square is 0.01 / 3
    figures = overfit_metrics(square(), Affine([1.1, 0, 0], [0, 1, 0], [0, 0, 0]), samples=200_000)
    assert figures["rms_percent"] == pytest.approx(100 * np.sqrt(0.01 / 3) / DIAGONAL, rel=0.01)
    assert figures["hausdorff_phi_to_mesh_percent"] == pytest.approx(10 / DIAGONAL, rel=1e-6)
    assert figures["hausdorff_mesh_to_phi_percent"] == pytest.approx(0, abs=1e-6)


def test_a_tilt_is_the_angle_between_normals():
    tilt = np.radians(30)
    phi = Affine([np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [0, 0, 0])
    figures = overfit_metrics(square(), phi, samples=2000)
    assert figures["normal_error_mean_degrees"] == pytest.approx(30, abs=1e-6)
    assert figures["normal_error_p95_degrees"] == pytest.approx(30, abs=1e-6)


def test_a_collapsed_map_is_degenerate_everywhere():
    figures = overfit_metrics(square(), Affine([1, 0, 0], [1, 0, 0], [0, 0, 0]), samples=2000)
    assert figures["degenerate_triangles_percent"] == 100


def test_the_seam_gap_is_the_distance_of_a_seam_pair():
    surface = square(seam_pairs=[(0, 5)])  # (-1, -1) and (-1, 1): 2 apart
    figures = overfit_metrics(surface, Affine([1, 0, 0], [0, 1, 0], [0, 0, 0]), samples=100)
    assert figures["seam_gap_percent"] == pytest.approx(200 / DIAGONAL)


@pytest.fixture
def neural() -> NeuralSurface:
    torch.manual_seed(0)
    network = NeuralMap(width=16, depth=1, encoding=RandomFourierFeatures(features=8))
    return NeuralSurface(square([(0, 5)]), network, {"rms_percent": 1.5}, {"seed": 3})


def test_saved_and_loaded_is_the_same(neural, tmp_path):
    save_surface(tmp_path, neural)
    again = load_surface(tmp_path)
    uv = torch.rand(10, 2)
    assert torch.equal(neural.map(uv), again.map(uv))
    for name in ("vertices", "faces", "uv", "seam_pairs", "source_vertex", "cut_vertex", "center"):
        assert np.array_equal(getattr(neural.surface, name), getattr(again.surface, name))
    assert again.metrics == neural.metrics
    assert again.config == neural.config
    assert not any(p.requires_grad for p in again.map.parameters())
    by_file = load_surface(tmp_path / "surface.safetensors")
    assert torch.equal(neural.map(uv), by_file.map(uv))


def test_original_units_come_back(neural):
    surface = neural.surface
    points = (surface.vertices / surface.scale) + surface.center
    assert np.allclose(neural.in_original_units(surface.vertices), points)


def truncate(folder):
    file = folder / "surface.safetensors"
    file.write_bytes(file.read_bytes()[:200])


def flip_a_byte(folder):
    file = folder / "surface.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(bytes(data))


def other_version(folder):
    file = folder / "surface.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "version": 99}))


def other_format(folder):
    (folder / "surface.json").write_text('{"hello": 1}')


def not_json(folder):
    (folder / "surface.json").write_text("{")


def deeply_nested(folder):
    (folder / "surface.json").write_text("[" * 100_000)


def without_map(folder):
    file = folder / "surface.json"
    metadata = json.loads(file.read_text())
    del metadata["map"]
    file.write_text(json.dumps(metadata))


def other_network(folder):
    file = folder / "surface.json"
    metadata = json.loads(file.read_text())
    metadata["map"]["width"] = 17
    file.write_text(json.dumps(metadata))


def other_domain(folder):
    file = folder / "surface.json"
    metadata = json.loads(file.read_text())
    metadata["surface"]["domain"] = "circle"
    file.write_text(json.dumps(metadata))


def gone(folder):
    (folder / "surface.safetensors").unlink()


@pytest.mark.parametrize(
    ("damage", "kind"),
    [
        (truncate, "damaged_file"),
        (flip_a_byte, "damaged_file"),
        (other_version, "wrong_version"),
        (other_format, "wrong_format"),
        (not_json, "damaged_file"),
        (deeply_nested, "damaged_file"),
        (without_map, "damaged_file"),
        (other_network, "damaged_file"),
        (other_domain, "damaged_file"),
        (gone, "missing_file"),
    ],
)
def test_a_damaged_artefact_is_refused_in_one_line(neural, tmp_path, damage, kind):
    save_surface(tmp_path, neural)
    damage(tmp_path)
    with pytest.raises(NsmError) as refused:
        load_surface(tmp_path)
    assert refused.value.kind == kind
    assert "\n" not in str(refused.value)
    assert Path(refused.value.key).is_relative_to(tmp_path)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    file = tmp_path / "figures.json"
    atomic_write(file, b"old")

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError) as error:
        atomic_write(file, b"new")
    assert error.value.errno == errno.ENOSPC
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("ending", [".obj", ".glb"])
def test_exported_meshes_carry_uv(tmp_path, ending):
    surface = square()
    texture = checkerboard(64)
    export_mesh(
        tmp_path / f"mesh{ending}", surface.vertices, surface.faces, surface.uv, texture=texture
    )
    mesh = trimesh.load(tmp_path / f"mesh{ending}", process=False, force="mesh")
    assert np.allclose(mesh.vertices, surface.vertices, atol=1e-6)
    assert np.array_equal(mesh.faces, surface.faces)
    assert np.allclose(mesh.visual.uv, 0.5 * (surface.uv + 1), atol=1e-6)


def test_colours_of_vertices_are_linear_in_glb(tmp_path):
    surface = square()
    grey = np.full((len(surface.vertices), 3), 0.5)
    export_mesh(tmp_path / "m.glb", surface.vertices, surface.faces, None, colours=grey)
    (mesh,) = trimesh.load(tmp_path / "m.glb", process=False).geometry.values()
    colours = mesh.visual.vertex_attributes["color"]
    assert set(colours[:, :3].ravel()) == {55}  # 255 ((0.5 + 0.055) / 1.055)^2.4
    assert b'"metallicFactor":0.0' in (tmp_path / "m.glb").read_bytes()  # by default, a mirror


def test_unknown_mesh_ending_is_refused(tmp_path):
    surface = square()
    with pytest.raises(NsmError) as refused:
        export_mesh(tmp_path / "mesh.fbx", surface.vertices, surface.faces, surface.uv)
    assert refused.value.kind == "unknown_format"


def test_the_rasteriser_agrees_with_the_plane():
    """Two crossing triangles: at each pixel the nearer one, with the right barycentrics."""
    xy = np.array([[2, 2], [60, 2], [2, 60], [2, 2], [60, 2], [2, 60]], dtype=float) + 0.25
    depth = np.array([0, 1, 0, 0.5, 0, 0.5])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    pixel, face, weights = rasterise(xy, depth, faces, 64)
    assert len(np.unique(pixel)) == len(pixel)
    x, y = pixel % 64 + 0.5, pixel // 64 + 0.5
    at = (weights[:, :, None] * xy[faces[face]]).sum(axis=1)
    assert np.allclose(at, np.stack([x, y], axis=1))
    s = (x - 2.25) / 58  # depths s and (1 - s) / 2 are equal at a third
    clear = np.abs(s - 1 / 3) > 1e-9
    assert np.array_equal(face[clear], (s < 1 / 3).astype(int)[clear])
    # half of a square of 58 pixels
    assert len(pixel) == pytest.approx(58 * 58 / 2, rel=0.03)


def test_a_drawn_square_fills_its_share_of_the_picture():
    surface = square()
    picture = View(surface.vertices, 128).draw(
        surface.vertices, surface.faces, lambda blend: np.zeros(3)
    )
    covered = (picture < 0.99).all(axis=2).mean()
    # 1 / 1.06 wide, and as much lower as the slanted view makes it
    assert covered == pytest.approx(np.sin(np.radians(50)) / 1.06**2, rel=0.03)


def test_no_crease_shows_where_a_mesh_was_cut():
    ball = trimesh.creation.icosphere(subdivisions=2)
    surface = Surface.from_arrays(ball.vertices, ball.faces, cache=False)
    exact = surface.vertices / np.linalg.norm(surface.vertices, axis=1)[:, None]
    turned = {}
    for name, seam_pairs in (("cut", None), ("whole", surface.seam_pairs)):
        normal = vertex_normals(surface.vertices, surface.faces, seam_pairs)
        turned[name] = np.degrees(np.arccos(np.clip((normal * exact).sum(axis=1), -1, 1)))
        assert np.allclose(np.linalg.norm(normal, axis=1), 1)
    assert turned["whole"].max() < 3 < turned["cut"].max()
    a, b = vertex_normals(surface.vertices, surface.faces, surface.seam_pairs)[surface.seam_pairs.T]
    assert np.allclose(a, b)


def test_pictures_are_not_blank(neural, tmp_path):
    error_picture(tmp_path / "error.png", neural.surface, neural)
    checkerboard_picture(tmp_path / "checkerboard.png", neural.surface, neural)
    for name in ("error.png", "checkerboard.png"):
        assert np.asarray(Image.open(tmp_path / name)).std() > 10
    quick = reconstruction_image(neural.surface, neural.map, size=96)
    assert quick.shape == (96, 96, 3)
    assert quick.dtype == np.uint8


def test_pictures_survive_a_map_that_is_not_a_number(neural, tmp_path):
    with torch.no_grad():
        for parameter in neural.map.parameters():
            parameter.fill_(float("nan"))
    assert (reconstruction_image(neural.surface, neural.map, size=32) == 255).all()


def test_points_in_either_precision_are_answered_in_theirs(neural):
    for dtype in (torch.float32, torch.float64):
        uv = torch.zeros(3, 2, dtype=dtype)
        assert neural(uv).dtype == dtype
        assert neural.jacobian(uv).dtype == dtype


def test_surfaces_of_one_name_keep_all_pairs_apart(tmp_path):
    neural, _, _, trio = results(rings=3)
    named = [replace(phi, surface=replace(phi.surface, name="mesh")) for phi in neural]
    trio = replace(trio, surfaces=named, _made={}, _back={})
    assert trio.names == ["mesh", "mesh-2", "mesh-3"]
    nothing = np.zeros((0, 2))
    figures = collection_metrics(trio, nothing, [nothing] * 3)
    assert len(figures["pairs"]) == 6
    replace(trio, metrics=figures).save(tmp_path)
    again = load_collection(tmp_path)
    figures_picture(tmp_path / "figures.png", again)
    assert again.metrics == json.loads(as_json(figures))


def test_figures_that_are_not_finite_are_written_as_standard_json():
    figures = {"a": [float("nan"), 1.0], "b": {"c": float("inf")}}
    assert json.loads(as_json(figures)) == {"a": [None, 1.0], "b": {"c": None}}


def test_a_surface_is_loaded_by_either_of_its_files(neural, tmp_path):
    save_surface(tmp_path, neural)
    for name in ("surface.json", "surface.safetensors"):
        assert load_surface(tmp_path / name).metrics == neural.metrics


def test_a_texture_does_not_take_the_name_of_another_picture(neural, tmp_path):
    (tmp_path / "shape.png").write_bytes(b"mine")
    export_mesh(tmp_path / "shape.OBJ", *neural.to_mesh(), texture=checkerboard(64))
    assert (tmp_path / "shape.png").read_bytes() == b"mine"
    assert "shape_texture.png" in (tmp_path / "shape.mtl").read_text()


def test_a_strip_has_the_pictures_in_their_places(tmp_path):
    file = tmp_path / "strip.png"
    pictures = [np.full((4, 6, 3), 40 * k, dtype=np.uint8) for k in range(4)]
    for k in (0, 1, 2, 1, 2, 3):  # interrupted after the third, resumed from before the second
        extend_strip(file, pictures[k], k)
    assert np.array_equal(np.asarray(Image.open(file)), np.concatenate(pictures, axis=1))


def test_landmarks_are_spheres_of_their_own_colours_in_a_picture():
    uv, faces = ring_mesh(8)
    vertices = np.column_stack([uv, np.zeros(len(uv))])
    at = np.array([0, len(uv) - 1])
    spheres, view = Spheres(vertices, faces, at), View(vertices, 128, frame=np.eye(3))

    def paint(blend):
        return blend(np.full((len(uv), 3), 0.5))

    drawn = view.draw(*spheres.mesh, spheres.painted(paint))
    coloured = np.ptp(drawn, axis=2) > 0.2
    assert 0 < coloured.mean() < 0.05
    centre = drawn[63, 63]
    assert centre[0] > 1.5 * centre[1:].max()  # hsv begins with red
    red = (drawn[:, :, 0] > drawn[:, :, 2]) & coloured
    other = (drawn[:, :, 0] < drawn[:, :, 2]) & coloured  # and has cyan in its middle
    assert red.sum() > 5 and other.sum() > 5


def test_the_normals_of_a_network_are_those_of_its_surface():
    phi = Affine([1, 0, 0], [0, 0, 1], [0, 0, 0])
    assert np.allclose(neural_normals(phi, np.zeros((3, 2))), [0, -1, 0])
    flat = Affine([1, 0, 0], [1, 0, 0], [0, 0, 0])
    assert np.allclose(neural_normals(flat, np.zeros((1, 2))), 0)


def test_pictures_take_the_triangles_normals_where_the_jacobian_vanishes():
    uv, faces = domain("disc").mesh(4)
    surface = Surface.from_arrays(np.column_stack([uv, 0 * uv[:, 0]]), faces)
    centre = int(np.linalg.norm(surface.uv, axis=1).argmin())
    branch = surface.uv[centre]

    class Squared(torch.nn.Module):  # z -> (z - c)^2, whose Jacobian is 0 at c
        def value_and_jacobian(self, uv):
            x, y = (uv - torch.as_tensor(branch)).T
            zero = torch.zeros_like(x)
            values = torch.stack([x * x - y * y, 2 * x * y, zero], dim=1)
            rows = [torch.stack(r, dim=1) for r in ((2 * x, -2 * y), (2 * y, 2 * x), (zero, zero))]
            return values, torch.stack(rows, dim=1)

    phi = Squared()
    assert np.allclose(neural_normals(phi, branch[None]), 0)
    assert np.allclose(normals_at_vertices(phi, surface), [0, 0, 1])


def test_pictures_of_normals_and_of_a_cycle_are_drawn(tmp_path):
    made = results(6)
    normals_picture(tmp_path / "normals.png", made.pair)
    cycle_picture(tmp_path / "cycle.png", made.trio)
    for name in ("normals.png", "cycle.png"):
        picture = np.asarray(Image.open(tmp_path / name).convert("RGB"), dtype=float)
        assert picture.std() > 20  # something is on it


@pytest.mark.parametrize("axis", UP_AXES)
def test_pictures_of_a_run_have_its_axis_upwards(axis, tmp_path, monkeypatch):
    reference = np.random.default_rng(0).normal(size=(20, 3)) * [3, 4, 5]
    frames = []

    class Drawing(Task):
        def choose_domain(self, given):
            frames.append(View(reference, 8).frame)
            raise StopIteration

    task = Drawing()
    monkeypatch.setattr(runner, "make_task", lambda config, console: task)
    with pytest.raises(StopIteration):
        runner.run_task(compose_config([f"up={axis}"]), tmp_path)
    sign = -1 if axis[0] == "-" else 1
    up = sign * frames[0][1]["xyz".index(axis[-1])]
    assert up > 0.9
    after = View(reference, 8).frame[1]
    assert after[1] > 0.9  # the caller's views are as they were


def test_landmarks_are_drawn_with_their_numbers(tmp_path):
    surfaces = [dome(0.2, 4), dome(0.4, 4)]
    files = [tmp_path / f"{k}.png" for k in range(2)]
    ids = np.array([0, 10, -1, 30])
    landmarks_picture(files[0], surfaces, [ids, ids])
    landmarks_picture(files[1], surfaces, [np.full(4, -1)] * 2)
    with_marks, without = (np.asarray(Image.open(f).convert("RGB"), dtype=int) for f in files)
    assert np.ptp(without, axis=2).max() < 10  # grey
    marked = np.ptp(with_marks, axis=2) > 100
    assert marked.sum() > 50  # spheres
    landmarks_picture(files[1], surfaces, [ids, np.array([0, 10, 20, 30])])
    every = np.asarray(Image.open(files[1]).convert("RGB"), dtype=int)
    # those that a surface lacks do not change the colours of the others
    assert (every[marked] == with_marks[marked]).all(axis=1).mean() > 0.95
