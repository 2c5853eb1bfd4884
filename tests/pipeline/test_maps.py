"""Maps between surfaces, as users run them: from meshes, ready surfaces, in Python, resumed."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from interruption import interrupted
from rich.console import Console
from tensor_checks import check_correspondences, check_tensors, check_weights
from tiny import QUICK, results

import nsm
from nsm.config import compose_config
from nsm.domains import Square
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline import Given, built, make_task, run_task
from nsm.pipeline.landmark_inputs import landmark_vertices
from nsm.results import analytic_surface
from nsm.results.metrics import evaluate
from nsm.results.textured_mesh import TexturedMesh
from nsm.surfaces.atlas import unwrapped
from nsm.surfaces.geometry import point_mesh_distance
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.shapes import grid_mesh
from nsm.surfaces.textures import read_texture

MADE = (
    'phi.overrides=["experiment=quick","trainer.threads=1","data.batch_size=512",'
    '"data.held_out=512","trainer.max_steps=30"]'
)
PENALTY = [
    "constraints.boundary=penalty",
    "constraints.landmarks=fixed",
    "constraints.ramp=0",
    "loss_weights.seam=0",
    "loss_weights.triangles=0",
]
SEAM = "seam.path=shortest"
POINTS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0.0]])


def nearest(vertices, points):
    return [int(np.linalg.norm(vertices - p, axis=1).argmin()) for p in points]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two closed meshes of one shape, and their landmarks."""
    folder = tmp_path_factory.mktemp("meshes")
    ball = trimesh.creation.icosphere(subdivisions=2)
    egg = trimesh.creation.icosphere(subdivisions=3)
    ids = {"ball": nearest(ball.vertices, POINTS), "egg": nearest(egg.vertices, POINTS)}
    egg.vertices = egg.vertices * [1.3, 1.0, 0.9]
    ball.export(folder / "ball.obj")
    egg.export(folder / "egg.obj")
    for name, listed in ids.items():
        (folder / f"{name}.vts").write_text("".join(f"{i} 0 0 0\n" for i in listed))
    pairs = list(zip(ids["ball"], ids["egg"], strict=True))
    (folder / "pairs.json").write_text(json.dumps({"pairs": pairs}))
    return folder


@pytest.fixture(scope="module")
def made(files, tmp_path_factory):
    """A whole run from raw meshes with landmarks."""
    folder = tmp_path_factory.mktemp("run") / "map"
    f = nsm.map_pair(
        files / "ball.obj",
        files / "egg.obj",
        files / "pairs.json",
        overrides=[*QUICK, MADE, SEAM, "trainer.max_steps=100"],
        folder=folder,
        progress=False,
    )
    return folder, f


def test_a_map_of_meshes_meets_its_landmarks_without_flips(made):
    _, f = made
    assert f.metrics["flipped_percent"] == 0
    assert f.metrics["outside_percent"] == 0
    assert f.metrics["landmark_error_max_percent"] < 0.5
    assert f.metrics["symmetric_dirichlet_median"] < 5
    assert f.metrics["covered_percent"] > 99
    assert f.metrics["boundary_distance_max"] < 1e-6


def test_a_run_leaves_all_that_the_readme_names(made):
    folder, _ = made
    for name in (
        "metrics.json",
        "config.yaml",
        "pair.safetensors",
        "mapped.obj",
        "mapped_vertices.npy",
        "target_with_source_uv.glb",
        "source_with_target_uv.glb",
        "transfer.png",
        "distortion.png",
        "morph.png",
        "morph.gif",
        "morph/08.obj",
        "morph.glb",
        "correspondences.npz",
        "reliability.ply",
        "reliability.png",
    ):
        assert (folder / name).stat().st_size > 0, name


def test_glb_files_of_a_map_are_valid(made, valid_gltf):
    names = {"mapped.glb", "morph.glb", "source_with_target_uv.glb", "target_with_source_uv.glb"}
    assert valid_gltf(made[0]) == names


def test_the_image_of_a_closed_mesh_is_a_closed_mesh(made, files):
    folder, f = made
    ball = trimesh.load(files / "ball.obj", process=False)
    egg = trimesh.load(files / "egg.obj", process=False)
    mapped = trimesh.load(folder / "mapped.obj", process=False, maintain_order=True)
    assert f.metrics["seam_gap_max_percent"] > 0
    image = np.load(folder / "mapped_vertices.npy")
    assert image.shape == ball.vertices.shape
    assert point_mesh_distance(image, np.asarray(egg.vertices), egg.faces).max() < 1e-6
    assert np.allclose(image, f.target.in_original_units(f.welded_image))
    # in the file: the source's vertices and faces, with texture coordinates of their own
    lines = (folder / "mapped.obj").read_text().splitlines()
    vertices = np.array([line.split()[1:] for line in lines if line.startswith("v ")], dtype=float)
    rows = [line.split()[1:] for line in lines if line.startswith("f ")]
    faces = np.array([[int(corner.split("/")[0]) for corner in row] for row in rows]) - 1
    assert np.allclose(vertices, image, atol=1e-6)
    assert {tuple(sorted(f)) for f in faces.tolist()} == {
        tuple(sorted(f)) for f in ball.faces.tolist()
    }
    assert trimesh.Trimesh(vertices, faces, process=False).is_watertight
    assert np.allclose(mapped.area, trimesh.Trimesh(vertices, faces).area, rtol=1e-6)
    assert f.metrics["welded_flipped_triangles"] == 0
    diagonal = f.target.surface.bounding_box_diagonal
    moves = np.linalg.norm(f.weld.points - f.image, axis=1)
    assert f.metrics["welded_move_max_percent"] == pytest.approx(100 * moves.max() / diagonal)
    # landmarks stay
    first = f.source.surface.cut_vertex[f.landmarks[:, 0]]
    assert np.allclose(f.weld.points[first], f.image[first], atol=1e-9)


def test_a_map_is_given_back_as_it_was(made):
    folder, f = made
    again = nsm.load(folder)
    assert isinstance(again, nsm.SurfaceMap)
    points = np.random.default_rng(0).normal(size=(50, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert np.abs(again(points) - f(points)).max() < 1e-6
    assert again.metrics == f.metrics
    assert (again.landmarks == f.landmarks).all()


def test_points_go_to_the_target_in_its_own_units(made, files):
    _, f = made
    ball = trimesh.load(files / "ball.obj", process=False)
    egg = trimesh.load(files / "egg.obj", process=False)
    points = ball.triangles_center
    image = f(points)
    assert point_mesh_distance(image, np.asarray(egg.vertices), egg.faces).max() < 1e-6
    # landmarks go to landmarks, in the units of the files
    ids = f.landmarks
    off = np.linalg.norm(f(ball.vertices[ids[:, 0]]) - egg.vertices[ids[:, 1]], axis=1)
    assert off.max() < 0.02


def test_points_may_be_tensors_that_a_gradient_is_wanted_of(made):
    _, f = made
    points = torch.tensor(f.source.in_original_units(f.source.surface.vertices[:5]))
    image = f(points.requires_grad_())
    assert image.requires_grad
    assert np.allclose(image.detach().numpy(), f(points.detach().numpy()), rtol=0, atol=1e-9)


def test_maps_of_cut_surfaces_take_tensors_and_correspond(made):
    _, f = made
    check_tensors(f)
    check_weights(f)
    check_correspondences(f)


def test_results_are_shown_in_a_line(made, trio):
    for name, shown in (("ball", repr(made[1])), ("cone", repr(trio))):
        assert f"name='{name}'" in shown and len(shown) < 500


def test_values_are_carried_over_and_back(made, files):
    _, f = made
    ball = trimesh.load(files / "ball.obj", process=False)
    colours = np.asarray(ball.vertices) * 0.5 + 0.5
    there = f.transfer(colours)
    egg = trimesh.load(files / "egg.obj", process=False)
    assert there.shape == (len(egg.vertices), 3)
    again = f.transfer(there, back=True)
    assert np.abs(again - colours).mean() < 0.02
    labels = (np.asarray(ball.vertices)[:, 0] > 0).astype(int)
    carried = f.transfer(labels)
    assert carried.dtype == labels.dtype and set(np.unique(carried)) == {0, 1}
    with pytest.raises(NsmError):
        f.transfer(colours[:10])


def test_a_file_with_copies_of_vertices_in_other_units(made, files, tmp_path):
    _, f = made
    egg = trimesh.load(files / "egg.obj", process=False)
    ball = np.asarray(trimesh.load(files / "ball.obj", process=False).vertices)
    n = len(egg.vertices)
    copied = egg.faces + n * (np.arange(len(egg.faces)) % 2)[:, None]
    points = 2 * np.concatenate([egg.vertices, egg.vertices, [[0, 0, 0]]])  # the last in no face
    trimesh.Trimesh(points, copied, process=False).export(tmp_path / "egg in cm.obj")
    pairs = [(i, j + n * (j % 2)) for i, j in f.landmarks.tolist()]
    settings = [*QUICK, MADE, SEAM, "trainer.max_steps=100"]
    place = [files / "ball.obj", tmp_path / "egg in cm.obj"]
    g = nsm.map_pair(*place, pairs, overrides=settings, progress=False)
    assert g.target.surface.name == "egg in cm"
    assert np.allclose(g(ball), 2 * f(ball))
    there, expected = g.transfer(ball), f.transfer(ball)
    assert there.shape == (len(points), 3)
    assert np.allclose(there[:n], expected) and np.allclose(there[n:-1], expected)
    assert np.allclose(g.transfer(there, back=True), f.transfer(expected, back=True))
    for wrong in (there[:-1], np.concatenate([there, there])):
        with pytest.raises(NsmError):
            g.transfer(wrong, back=True)
    g.save(tmp_path / "saved")
    assert np.array_equal(nsm.load(tmp_path / "saved").transfer(ball), there)


def test_a_morph_begins_at_the_source_and_ends_at_the_image(made):
    _, f = made
    vertices, faces = f.source.file_mesh()
    assert (f.morph(0.0) == vertices).all()
    end, image = f.morph(1.0), f.welded_image / f.source.surface.scale
    # a rigid motion keeps all distances
    edges = faces[:, :2]
    lengths = [np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (end, image)]
    assert np.abs(lengths[0] - lengths[1]).max() < 1e-9


def test_figures_agree_with_an_independent_count(made):
    _, f = made
    s = f.source.surface
    a, b, c = (np.c_[f.image_uv, np.zeros(len(s.uv))][s.faces[:, k]] for k in range(3))
    flipped = (np.cross(b - a, c - a)[:, 2] <= 0).mean()
    assert f.metrics["flipped_percent"] == 100 * flipped
    median = np.median(distortions(s, f.image))
    assert f.metrics["symmetric_dirichlet_median"] == pytest.approx(median, rel=1e-6)


def distortions(s, image):
    """Symmetric Dirichlet by singular values of each triangle's affine map."""
    values = []
    for x, y in zip(s.vertices[s.faces], image[s.faces], strict=True):
        e, g = np.stack([x[1] - x[0], x[2] - x[0]], 1), np.stack([y[1] - y[0], y[2] - y[0]], 1)
        q, r = np.linalg.qr(e)
        sigma = np.linalg.svd(g @ np.linalg.inv(r), compute_uv=False)
        values.append((sigma**2).sum() + (1 / (sigma**2 + 0.01)).sum())
    return values


def test_a_map_is_compared_with_its_start(made):
    _, f = made
    s, t = f.source.surface, f.target.surface
    image = t.at(s.uv @ f.map.rotation.double().numpy().T)
    found = f.metrics["start_symmetric_dirichlet_median"]
    assert found == pytest.approx(np.median(distortions(s, image)), rel=1e-6)
    assert found > f.metrics["symmetric_dirichlet_median"]
    assert f.metrics["start_flipped_percent"] == 0  # a rotation of Ω
    # the seams lead through all landmarks, which have the same places on both discs
    assert f.metrics["start_landmark_error_max_percent"] == pytest.approx(0, abs=1e-3)


def test_neural_surfaces_that_are_ready_are_mapped_as_they_are(made):
    _, f = made
    again = nsm.map_pair(
        f.source,
        f.target,
        f.landmarks.tolist(),
        overrides=[*QUICK, "trainer.max_steps=20"],
        progress=False,
    )
    assert again.source is f.source
    assert again.metrics["landmark_error_max_percent"] < 5


@pytest.mark.parametrize("domain", ["disc", "square"])
def test_analytic_targets_and_no_landmarks(here, domain):
    run = here(
        "task=pair_map",
        "source=hemisphere",
        "target={name: graph, z: 0.3*u*v}",
        f"domain={domain}",
        *QUICK,
        MADE,
        "trainer.max_steps=30",
        "logger=none",
        "artefacts=false",
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.count(" faces on the ") == 1  # the source is reported once
    folder = run.stdout.strip().splitlines()[-1].removeprefix("results in ")
    f = nsm.load(folder)
    assert f.target.surface.name == "graph"
    assert "landmarks_sure" not in f.metrics  # there is nothing to correspond
    assert f.metrics["flipped_percent"] == 0 and f.metrics["outside_percent"] == 0


def test_penalties_keep_the_corners_of_the_square_as_key_points(on_the_square):
    f = on_the_square
    corners = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    moved = evaluate(f.map, corners)
    off = np.linalg.norm(moved[:, None] - corners[None], axis=2).min(axis=1)
    assert off.max() < 0.05


@pytest.fixture(scope="module")
def on_the_square():
    return nsm.map_pair(
        "saddle",
        "plane",
        overrides=[*QUICK, MADE, "domain=square", *PENALTY, "trainer.max_steps=60"],
        progress=False,
    )


def test_the_corners_of_the_square_are_key_points_of_a_collection(monkeypatch):
    monkeypatch.setattr(Square, "mesh", lambda self, rings=12: grid_mesh(8))
    config = compose_config(["task=collection_map", "experiment=paper", "domain=square"])
    task = make_task(config, Console(quiet=True))
    shapes = [analytic_surface({"name": n}, Square()) for n in ("plane", "saddle", "paraboloid")]
    task.use(shapes, [np.zeros(0, dtype=np.int64)] * 3)
    module = built(task)
    corners = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    assert sorted(module.points.tolist()) == sorted(corners.tolist())
    for k, targets in enumerate(module.targets):
        assert sorted(targets.round(decimals=5).tolist()) == sorted(corners.tolist())
        # h_k starts as a turn of the square by quarters
        torch.testing.assert_close(module.map[k](module.points), targets, atol=1e-5, rtol=0)


def test_attributes_of_files_are_carried_by_the_command(here, tmp_path):
    count = len(nsm.Surface.load("hemisphere").vertices)
    np.save(tmp_path / "heat.npy", np.linspace(0, 1, count))
    words = ["task=pair_map", "source=hemisphere", "target=sphere_cap", *QUICK, MADE]
    words += ["trainer.max_steps=10", "landmarks=[]", "logger=none", "artefacts=false"]
    run = here(*words, "attributes.source=heat.npy")
    assert run.returncode == 0, run.stderr
    folder = run.stdout.strip().splitlines()[-1].removeprefix("results in ")
    carried = np.load(f"{folder}/heat_on_target.npy")
    assert carried.min() >= 0 and carried.max() <= 1 and carried.std() > 0.1


def test_an_interrupted_map_ends_at_the_same_result(made, tmp_path):
    _, f = made
    words = [*QUICK, "data.steps_per_epoch=10", "trainer.max_steps=20"]
    words += ["logger=none", "artefacts=false"]

    def run(folder, **extra):
        config = compose_config(["task=pair_map", "trainer.progress=false", *words])
        given = Given(source=f.source, target=f.target, landmarks=f.landmarks.tolist())
        return run_task(config, folder, given, **extra)

    whole = run(tmp_path / "whole")
    # the same, stopped in the middle: the checkpoint of step 10
    with interrupted(at=10):
        run(tmp_path / "parted")
    resumed = run(tmp_path / "parted", resuming=True)
    assert (resumed.image_uv == whole.image_uv).all()


@pytest.fixture(scope="module")
def folder_of_trio(tmp_path_factory):
    return tmp_path_factory.mktemp("trio")


@pytest.fixture(scope="module")
def trio(folder_of_trio):
    return nsm.map_collection(
        ["hemisphere", "saddle", "cone"],
        overrides=[
            *(*QUICK, MADE, "trainer.max_steps=60", "data.steps_per_epoch=20"),
            *("logger=csv", "artefacts=false"),
        ],
        folder=folder_of_trio,
        progress=False,
    )


def test_each_pair_of_a_collection_has_a_curve(trio, folder_of_trio):
    with (folder_of_trio / "csv" / "metrics.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["val/distortion"]]
    assert len(rows) == 3
    names = [f"pairs/{name.replace(' → ', '_to_')}" for name in trio.metrics["pairs"]]
    assert sorted(names) == sorted(name for name in rows[0] if name.startswith("pairs/"))
    for row in rows:
        mean = np.mean([float(row[name]) for name in names])
        assert mean == pytest.approx(float(row["val/distortion"]), rel=1e-5)


def test_a_collection_maps_every_surface_to_every_other(trio):
    assert len(trio.metrics["pairs"]) == 6
    for figures in trio.metrics["pairs"].values():
        assert figures["flipped_percent"] == 0
        assert figures["symmetric_dirichlet_median"] < 6
        assert figures["start_flipped_percent"] == 0
    for (i, j), name in trio.pair_names.items():
        s, t = trio.surfaces[i].surface, trio.surfaces[j].surface
        first, then = (trio.maps[k].rotation.double().numpy() for k in (i, j))
        median = np.median(distortions(s, t.at(s.uv @ first @ then.T)))
        found = trio.metrics["pairs"][name]["start_symmetric_dirichlet_median"]
        assert found == pytest.approx(median, rel=1e-5)
    assert trio.metrics["cycle_error_networks_mean_percent"] < 0.01
    assert trio.metrics["cycle_error_mean_percent"] < 0.2


def test_the_picture_of_a_collection_is_that_of_the_map_not_of_one_h():
    phis = results(3).neural
    same = [phis[0], phis[0], phis[0]]
    task = make_task(compose_config(["task=collection_map", "map.cells=8"]), Console())
    task.use(same, [np.zeros(0, dtype=np.int64)] * 3)
    module = built(task)
    start = task.picture(module).astype(float)
    with torch.no_grad():
        for parameter in module.map.parameters():  # alike: the map remains the identity
            bent = torch.linspace(-0.3, 0.3, parameter.numel()).sin()
            parameter.add_(bent.reshape(parameter.shape))
    together = task.picture(module).astype(float)
    with torch.no_grad():
        for parameter in module.map[0].parameters():
            parameter.mul_(0)
    apart = task.picture(module).astype(float)
    assert abs(together - start).mean() < 0.3 * abs(apart - start).mean()


def test_the_maps_of_a_collection_are_inverse_to_each_other(trio):
    there, back = trio.pair(0, 2), trio.pair(2, 0)
    points = trio.surfaces[0].in_original_units(trio.surfaces[0].surface.vertices[::5])
    again = back(there(points))
    # linear on triangles there and back: inverse up to the size of these
    assert np.median(np.linalg.norm(again - points, axis=1)) < 3e-3
    uv = trio.surfaces[0].surface.uv
    assert np.median(np.abs(evaluate(back.map, evaluate(there.map, uv)) - uv)) < 1e-6


def test_a_collection_is_given_back(trio, tmp_path):
    trio.save(tmp_path)
    again = nsm.load(tmp_path)
    assert isinstance(again, nsm.SurfaceCollection)
    assert np.abs(again.pair(0, 1).image_uv - trio.pair(0, 1).image_uv).max() < 1e-9
    (tmp_path / "collection.safetensors").write_bytes(b"short")
    with pytest.raises(NsmError) as error:
        nsm.load(tmp_path)
    assert error.value.kind == "damaged_file"


def test_closed_shapes_are_put_into_a_collection_through_their_landmarks(files):
    names = ["ball", "egg", "ball"]
    group = nsm.map_collection(
        [files / f"{n}.obj" for n in names],
        [files / f"{n}.vts" for n in names],
        overrides=[*QUICK, MADE, SEAM, "trainer.max_steps=50"],
        progress=False,
    )
    for figures in group.metrics["pairs"].values():
        assert figures["flipped_percent"] == 0
        assert figures["landmark_error_max_percent"] < 2


def test_textures_are_carried_both_ways_by_the_command(here, tmp_path):
    """The source is painted in its own UV, the target in an atlas; both colours are constant."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    for name, colour in (("ball", [200, 30, 60]), ("egg", [20, 90, 210])):
        vertices, faces = np.asarray(ball.vertices) * [1.0, 1.2, 0.9], np.asarray(ball.faces)
        image = np.tile(np.array(colour, dtype=np.uint8), (32, 32, 1))
        TexturedMesh(vertices, faces, unwrapped(vertices, faces), image).export(
            tmp_path / f"{name}.obj"
        )
    run = here(
        *QUICK,
        MADE,
        *("task=pair_map", "source=ball.obj", "target=egg.obj", "landmarks=[]"),
        *("texture=own", "texture_size=64", "trainer.max_steps=3", "logger=none"),
        *("trainer.progress=false", "artefacts=false"),
        "hydra.run.dir=run",
    )
    assert run.returncode == 0, run.stderr
    assert "texture on the target" in run.stdout and "texture on the source" in run.stdout
    for name, end, colour in (
        ("target_textured", "egg", [200, 30, 60]),
        ("source_textured", "ball", [20, 90, 210]),
    ):
        for ending in ("obj", "glb"):
            texture = read_texture(tmp_path / "run" / f"{name}.{ending}")
            assert texture.images[0].shape == (64, 64, 3) and (texture.images[0] == colour).all()
        for mine, other in zip(
            load_mesh(tmp_path / "run" / f"{name}.obj")[:2],
            load_mesh(tmp_path / f"{end}.obj")[:2],
            strict=True,
        ):
            assert np.array_equal(mine, other)
    f = nsm.load(tmp_path / "run")
    mesh = f.bake(tmp_path / "ball.obj", tmp_path / "egg.obj", size=32)
    assert (mesh.image == [200, 30, 60]).all()


# with the kind of the error, and the name of the file, surface or setting concerned
BAD = [
    ("landmarks=[[99999,1]]", "out_of_range", "a"),
    ("landmarks=[[1,1],[1,2]]", "duplicate_landmark", "a"),
    ("source=twice.obj landmarks=[[0,0],[162,5]]", "duplicate_landmark", "twice"),
    ("landmarks=[a.vts,b.vts]", "different_lengths", "landmarks"),
    ("landmarks=nowhere.json", "missing_file", "nowhere.json"),
    ("landmarks=broken.json", "damaged_file", "broken.json"),
    ("landmarks=[[[9.0,9.0,9.0],1]]", "not_on_surface", "a"),
    ("target=null", "missing_setting", "target"),
    ("target={name:spere_cap}", "unknown_option", "name"),
    ("target=ready domain=square", "wrong_domain", "target"),
    ("target=cut", "damaged_file", "surface.safetensors"),
    ("target=old", "wrong_version", "surface.json"),
    ("constraints.boundary=soft", "unknown_option", "constraints.boundary"),
    ("seam.path=sideways landmarks=[[1,1],[5,5]]", "unknown_option", "seam.path"),
    ("attributes.source=a.vts landmarks=[]", "unreadable_file", "attributes.source"),
    ("texture=own", "missing_texture", "a.obj"),
    ("texture=nowhere.png", "missing_file", "nowhere.png"),
    ("texture=broken.json", "unreadable_file", "broken.json"),
    ("texture=own target=ready", "wrong_type", "texture"),
    ("texture_size=0", "out_of_range", "texture_size"),
]


@pytest.fixture(scope="module")
def bad_files(made, files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bad")
    ready, _ = made
    shutil.copytree(ready / "target", folder / "ready")
    shutil.copytree(ready / "target", folder / "cut")
    whole = (folder / "cut" / "surface.safetensors").read_bytes()
    (folder / "cut" / "surface.safetensors").write_bytes(whole[: len(whole) // 2])
    shutil.copytree(ready / "target", folder / "old")
    words = json.loads((folder / "old" / "surface.json").read_text())
    (folder / "old" / "surface.json").write_text(json.dumps({**words, "version": 99}))
    (folder / "a.vts").write_text("1 0 0 0\n")
    (folder / "b.vts").write_text("1 0 0 0\n2 0 0 0\n")
    (folder / "broken.json").write_text("[[1, 2")
    for name, mesh in (("a", "ball"), ("b", "egg")):
        shutil.copy(files / f"{mesh}.obj", folder / f"{name}.obj")
    vertices, faces = (np.array(part) for part in load_mesh(folder / "a.obj")[:2])
    corner = tuple(np.argwhere(faces == 0)[0])  # vertex 162 is a duplicate of vertex 0
    faces[corner] = len(vertices)
    twice = trimesh.Trimesh(np.vstack([vertices, vertices[:1]]), faces, process=False)
    twice.export(folder / "twice.obj")
    return folder


@pytest.mark.parametrize(("words", "kind", "key"), BAD, ids=[words for words, *_ in BAD])
def test_bad_input_is_refused(bad_files, tmp_path, monkeypatch, words, kind, key):
    monkeypatch.chdir(bad_files)
    monkeypatch.setenv("NSM_CACHE", str(tmp_path / "cache"))
    quick = [*QUICK, MADE, "trainer.max_steps=1", "logger=none", "trainer.progress=false"]
    quick += ["task=pair_map", "source=a.obj", "target=b.obj", "artefacts=false"]
    with pytest.raises(NsmError) as error:
        run_task(compose_config([*quick, *words.split()]), tmp_path / "run")
    assert (error.value.kind, Path(error.value.key).name) == (kind, key)
    assert "\n" not in str(error.value)


def test_a_collection_needs_three_surfaces(here, tmp_path):
    run = here("task=collection_map", "surfaces=[saddle,cone]")
    assert run.returncode == 2 and "surfaces" in run.stderr
    assert not list(tmp_path.iterdir())  # no empty folder either


def test_landmarks_come_in_many_forms(tmp_path):
    vertices = np.arange(30, dtype=float).reshape(10, 3)
    shapes = [
        Mesh("a", vertices, np.zeros((0, 3), int)),
        Mesh("b", vertices, np.zeros((0, 3), int)),
    ]
    (tmp_path / "a.txt").write_text("1\n2\n")
    (tmp_path / "pairs.json").write_text("[[1, 3], [2, 4]]")
    forms = [
        [[1, 3], [2, 4]],
        np.array([[1.0, 3.0], [2.0, 4.0]]),  # as np.loadtxt gives it
        torch.tensor([[1, 3], [2, 4]]),
        [(np.int64(1), torch.tensor(3)), (np.float64(2), 4)],
        {"source": [1, 2], "target": [3, 4]},
        str(tmp_path / "pairs.json"),
        [[vertices[1].tolist(), 3], [vertices[2].tolist(), 4]],
    ]
    for form in forms:
        a, b = landmark_vertices(form, shapes)
        assert a.tolist() == [1, 2] and b.tolist() == [3, 4]
    both = landmark_vertices([str(tmp_path / "a.txt")] * 2, shapes)
    assert both[0].tolist() == both[1].tolist() == [1, 2]
    assert [len(x) for x in landmark_vertices(None, shapes)] == [0, 0]
    for form in ([[1, 3], [2.5, 4]], [[1, 3], [float("nan"), 4]]):
        with pytest.raises(NsmError):
            landmark_vertices(form, shapes)
