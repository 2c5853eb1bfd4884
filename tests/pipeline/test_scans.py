"""A folder of scans, as users have it: a pattern, a template, landmarks found by name."""

import itertools
import json

import numpy as np
import pytest
import pytorch_lightning as pl
import trimesh

import nsm
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline.collection_inputs import collected
from nsm.pipeline.landmark_inputs import landmark_vertices
from nsm.surfaces import topology
from nsm.surfaces.geometry import point_mesh_distance
from nsm.surfaces.shapes import ring_mesh

NAMES = ["right", "back", "left", "front"]
QUICK = [
    "experiment=quick",
    'phi.overrides=["experiment=quick","encoding.resolutions=[8]","trainer.max_steps=20"]',
    "surface.parameterization=tutte",
    "trainer.max_steps=40",
    "data.steps_per_epoch=40",
    "data.held_out=256",
    "trainer.progress=false",
    "logger=none",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A template and two scans of it, in millimetres; the second lacks a landmark."""
    place = tmp_path_factory.mktemp("scans")
    (place / "scans").mkdir()
    flat, faces = ring_mesh(8)
    dome = np.column_stack([flat, 0.4 - 0.4 * (flat**2).sum(axis=1)])
    ends = [int(np.argmax(flat @ d)) for d in ([0.5, 0], [0, 0.5], [-0.5, 0], [0, -0.5])]
    inner = [int(np.linalg.norm(flat - 0.5 * flat[e], axis=1).argmin()) for e in ends]

    def write(path, points, ids):
        trimesh.Trimesh(points, faces, process=False).export(path)
        words = [f"{i} {name}\n" for i, name in zip(ids, NAMES, strict=True)]
        path.with_suffix(".vts").write_text("".join(words))

    write(place / "template.ply", 100 * dome, inner)
    for k in range(2):
        ids = [*inner[:3], -1] if k == 1 else inner
        write(place / "scans" / f"scan{k + 1}.ply", 100 * dome * [1 + 0.1 * k, 1, 1] + 500, ids)
    return place


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    place = tmp_path_factory.mktemp("run") / "all"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for picture in ("figures_picture", "transfer_matrix_picture"):  # which other tests draw
            patch.setattr(f"nsm.pipeline.collection_map.{picture}", lambda *_: None)
        group = nsm.map_collection(
            "scans/*.ply", template="template.ply", overrides=QUICK, folder=place, progress=False
        )
    return place, group


def test_pairs_are_named_by_their_surfaces(run):
    _, group = run
    assert group.names == ["template", "scan1", "scan2"]
    assert group.pair("template", "scan2") is group.pair(0, 2)
    assert group.pair("scan1", 2).source is group.surfaces[1]
    for wrong in ("scan4", 3, -1):
        with pytest.raises(NsmError) as refused:
            group.pair("template", wrong)
        assert (refused.value.kind, refused.value.key) == ("out_of_range", "surface")


def test_each_pair_has_the_landmarks_that_both_have(run, folder):
    _, group = run
    assert group.landmarks.shape == (4, 3) and (group.landmarks < 0).sum() == 1
    for i, j in itertools.permutations(range(3), 2):
        assert len(group.pair(i, j).landmarks) == (3 if 2 in (i, j) else 4)
    for figures in group.metrics["pairs"].values():
        assert figures["flipped_percent"] == 0
        assert figures["landmark_error_max_percent"] < 5
    again = nsm.load(run[0])
    assert np.array_equal(again.landmarks, group.landmarks)
    assert len(again.pair("scan2", "scan1").landmarks) == 3


def test_the_template_lies_on_each_scan(run, folder):
    place, group = run
    template = trimesh.load(folder / "template.ply", process=False)
    for name in ("scan1", "scan2"):
        mesh = trimesh.load(place / f"{name}_in_template.ply", process=False)
        assert np.array_equal(mesh.faces, template.faces)
        scan = trimesh.load(folder / "scans" / f"{name}.ply", process=False)
        off = point_mesh_distance(np.asarray(mesh.vertices), np.asarray(scan.vertices), scan.faces)
        assert off.max() < 1e-4 * np.linalg.norm(np.ptp(scan.vertices, axis=0))
        f = group.pair("template", name)
        assert np.allclose(mesh.vertices, f.target.in_original_units(f.welded_image))
    folders = {p.name for p in place.iterdir() if p.is_dir() and "_to_" in p.name}
    assert folders == {
        f"{a}_to_{b}" for n in group.names[1:] for a, b in ((n, "template"), ("template", n))
    }
    said = json.loads((place / "metrics.json").read_text())
    assert said["surfaces"] == group.names and said["template"] == "template"
    assert said["warnings"] == [] and (place / "landmarks.png").is_file()


def test_patterns_are_sorted_and_the_template_comes_first(folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "scans" / "notes.txt").write_text("nothing")
    names = [f"scans/scan{k}.ply" for k in (1, 2, 3)]
    (folder / "scans" / "scan3.ply").write_text("not read")
    assert collected("scans/*.ply") == collected(["scans/*"]) == names
    assert collected("scans/*.ply", "scans/scan2.ply") == [names[1], names[0], names[2]]
    assert collected(["cone", "scans/scan[13].ply"]) == ["cone", names[0], names[2]]
    for given, kind in (
        ("nowhere/*.ply", "missing_file"),
        ("scans/*.off", "missing_file"),
        ("scans/scan1*", "out_of_range"),
        (["a.ply", "b.ply"], "out_of_range"),
        (None, "out_of_range"),
    ):
        with pytest.raises(NsmError) as refused:
            collected(given)
        assert (refused.value.kind, refused.value.key) == (kind, "surfaces")
        assert "\n" not in str(refused.value)


def test_the_command_takes_patterns(here, folder, monkeypatch):
    for words in (
        ["task=collection_map", "surfaces=scans/*.ply", "template=~/t.ply"],
        ["collection_map", "scans/*.ply", "template=~/t.ply"],
    ):
        shown = here("--cfg", "job", *words)
        assert shown.returncode == 0, shown.stderr
        assert "scans/*.ply" in shown.stdout and "template: /" in shown.stdout
    refused = here("task=collection_map", "surfaces=nowhere/*.ply")
    assert refused.returncode == 2 and "nowhere" in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1


def test_glb_files_of_a_collection_are_valid(run, valid_gltf):
    assert "template_to_scan1/target_with_source_uv.glb" in valid_gltf(run[0])


@pytest.fixture
def shapes():
    vertices, faces = ring_mesh(3)
    points = np.column_stack([vertices, 0 * vertices[:, 0]])
    return [Mesh(name, points, faces) for name in ("template", "scan1", "scan2")]


def ids_of(given, shapes, **options):
    return [ids.tolist() for ids in landmark_vertices(given, shapes, **options)]


def test_missing_landmarks_in_every_form(tmp_path, shapes):
    expected = [[1, 2, 3], [4, -1, 6], [7, 8, 9]]
    points = [
        [None if i < 0 else shapes[k].vertices[i].tolist() for i in ids]
        for k, ids in enumerate(expected)
    ]
    arrays = [np.array([[np.nan] * 3 if p is None else p for p in one]) for one in points]
    rows = ["name,scan1,template,scan2", "a,4,1,7", "b,,2,8", "c,6,3,9"]
    (tmp_path / "all.csv").write_text("\n".join(rows))
    (tmp_path / "all.json").write_text(
        json.dumps({"landmarks": [[1, 2, 3], [4, None, 6], [7, 8, 9]]})
    )
    (tmp_path / "by name").mkdir()
    for shape, ids in zip(shapes, expected, strict=True):
        marks = {n: i for n, i in zip("abc", ids, strict=True) if i >= 0}
        (tmp_path / "by name" / f"{shape.name}.json").write_text(json.dumps(marks))
    for given in (
        expected,
        [[1, 2, 3], [4, None, 6], [7, 8, 9]],
        points,
        arrays,
        str(tmp_path / "all.csv"),
        str(tmp_path / "all.json"),
        str(tmp_path / "by name"),
    ):
        assert ids_of(given, shapes) == expected
    # a pair drops them
    assert ids_of(expected[:2], shapes[:2]) == [[1, 3], [4, 6]]
    assert ids_of([[1, 4], [2, -1], [3, 6]], shapes[:2]) == [[1, 3], [4, 6]]
    # what one surface alone has is dropped, and what the template lacks
    assert ids_of([[1, 2], [4, -1], [7, -1]], shapes) == [[1], [4], [7]]
    lacking = [[1, -1], [4, 5], [7, 8]]
    assert ids_of(lacking, shapes) == lacking
    assert ids_of(lacking, shapes, template=True) == [[1], [4], [7]]


@pytest.mark.parametrize(
    ("files", "kind"),
    [
        ({"template.vts": "1\n", "scan1.vts": "4\n"}, "missing_file"),
        (
            {"template.vts": "1\n", "scan1.vts": "4\n", "scan2.vts": "7\n", "scan2.pp": ""},
            "ambiguous_file",
        ),
        ({"all.csv": "template,scan1\n1,4\n"}, "different_names"),
        ({"all.csv": "template,scan1,scan2\n1,x,7\n"}, "damaged_file"),
        ({"all.csv": "template,template,scan2\n1,2,7\n"}, "damaged_file"),
        ({"all.csv": "template,scan1,scan2\n"}, "damaged_file"),
        ({"all.csv": "template,scan1,scan2\n1,4,\n"}, "different_names"),
    ],
)
def test_landmark_files_that_do_not_fit_are_refused(tmp_path, shapes, files, kind):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    given = tmp_path / "all.csv" if "all.csv" in files else tmp_path
    with pytest.raises(NsmError) as refused:
        landmark_vertices(str(given), shapes)
    assert refused.value.kind == kind and "\n" not in str(refused.value)


def masks():
    """Two domes with two holes each, of other sizes, and three landmarks."""
    made = []
    flat, faces = ring_mesh(10)
    for height, radius in ((0.3, 0.13), (0.5, 0.19)):
        points = np.column_stack([flat, height * (1 - (flat**2).sum(axis=1))])
        middle = flat[faces].mean(axis=1)
        holes = np.array([[0.4, 0.1], [-0.4, 0.1]])
        near = np.linalg.norm(middle[:, None] - holes, axis=2).min(axis=1) < radius
        used, number = topology.renumbered(faces[~near], len(flat))
        marks = [[0.0, 0.7], [0.0, -0.6], [0.0, 0.0]]
        ids = [int(np.linalg.norm(flat[used] - m, axis=1).argmin()) for m in marks]
        made.append((points[used], number[faces[~near]], ids))
    return made


def test_boundaries_are_mapped_to_boundaries():
    (v, f, p), (w, g, q) = masks()
    found = nsm.map_pair(
        (v, f),
        (w, g),
        list(zip(p, q, strict=True)),
        overrides=[*QUICK, "seam.path=shortest"],
        progress=False,
    )
    assert found.metrics["certified"]
    image = found.target.in_original_units(found.welded_image)
    loops = [topology.boundary_loops(faces) for faces in (f, g)]
    assert len(loops[0]) == len(loops[1]) == 3

    def middle(points, loop):
        return points[loop].mean(axis=0)

    for loop in loops[0]:
        other = min(loops[1], key=lambda o: np.linalg.norm(middle(w, o) - middle(image, loop)))
        # the eyes, at x = ±0.4, and the rim stay what they are
        assert np.linalg.norm(middle(w, other)[:2] - middle(v, loop)[:2]) < 0.1
        start, end = w[other], w[np.roll(other, -1)]
        along = ((image[loop][:, None] - start) * (end - start)).sum(axis=2)
        share = (along / ((end - start) ** 2).sum(axis=1)).clip(0, 1)
        off = np.linalg.norm(
            start + share[..., None] * (end - start) - image[loop][:, None], axis=2
        )
        assert off.min(axis=1).max() < 0.01 * np.linalg.norm(np.ptp(w, axis=0))


def test_surfaces_with_several_boundaries_that_were_cut_apart_are_refused_before_training(
    monkeypatch,
):
    (v, f, p), (w, g, q) = masks()

    def never(*_, **__):
        raise AssertionError("a training began")

    monkeypatch.setattr(pl.Trainer, "fit", never)
    with pytest.raises(NsmError) as refused:
        nsm.map_pair(
            (v, f),
            (w, g),
            list(zip(p, q, strict=True)),
            overrides=[*QUICK, "seam.path=own"],
            progress=False,
        )
    assert refused.value.kind == "no_common_seam" and "fill_holes" in str(refused.value)


def test_a_hole_is_filled_for_a_map_to_a_shape_without():
    (v, f, _), (w, g, _) = masks()
    flat, faces = ring_mesh(6)
    whole = np.column_stack([flat, 0.2 * flat[:, 0] ** 2])
    with pytest.raises(NsmError) as refused:
        nsm.map_pair((v, f), (whole, faces), overrides=QUICK, progress=False)
    assert refused.value.kind == "wrong_topology" and "fill_holes" in str(refused.value)
    found = nsm.map_pair(
        (v, f), (whole, faces), overrides=[*QUICK, "surface.fill_holes=true"], progress=False
    )
    assert found.metrics["certified"] and found.source.surface.filled.any()
    assert not found.target.surface.filled.any()
    assert found.transfer(np.ones(len(v))) == pytest.approx(1.0)
