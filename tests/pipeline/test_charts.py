"""task=param along given seams: one chart, or an atlas of several."""

import re
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import networkx
import numpy as np
import pytest
import torch
import trimesh
from tiny import FLATTENING, TRAINING

import nsm
from nsm.errors import NsmError
from nsm.results.parameterization import in_file_units
from nsm.results.parameterization_atlas import ParameterizationAtlas
from nsm.results.textured_mesh import TexturedMesh
from nsm.results.view import serving
from nsm.results.view.scene import scene_of
from nsm.surfaces import topology
from nsm.surfaces.loading import load_mesh
from nsm.surfaces.location import Places

OWN = ("surface.path", "trainer.progress", "artefacts")
TINY = [word for word in FLATTENING if not word.startswith(OWN)]
OF_PHI = [word for word in TRAINING if not word.startswith((*OWN, "surface"))]
WORDS = [*TINY, "phi.overrides=[" + ",".join(f"'{word}'" for word in OF_PHI) + "]"]


def halves():
    """A ball in millimetres, and texture coordinates in which its halves are islands."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = 30 * np.asarray(ball.vertices), np.asarray(ball.faces)
    upper = vertices[faces].mean(axis=1)[:, 2] > 0
    uv = vertices[faces][:, :, :2] / 140 + np.where(upper, 0.25, 0.75)[:, None, None]
    return vertices, faces, uv


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("atlas")
    vertices, faces, uv = halves()
    TexturedMesh(vertices, faces, uv, np.full((4, 4, 3), 9, np.uint8)).export(folder / "ball.obj")
    atlas = nsm.parameterize(
        folder / "ball.obj", seams="uv", overrides=WORDS, folder=folder / "run", progress=False
    )
    return folder / "run", atlas


def test_islands_are_flattened_one_by_one_and_packed(run):
    folder, atlas = run
    assert isinstance(atlas, ParameterizationAtlas) and len(atlas.charts) == 2
    for chart, uv in zip(atlas.charts, atlas.uv, strict=True):
        assert chart.certificate["certified"]
        assert uv.min() >= 0 and uv.max() <= 1
        flat = chart.uv / chart.phi.surface.scale  # in the units of the file
        assert np.allclose(uv - uv[0], atlas.scale * (flat - flat[0]))
    assert set(atlas.metrics) == {"ball-0", "ball-1"}
    again = nsm.load(folder)
    assert isinstance(again, ParameterizationAtlas)
    assert all(np.allclose(a, b) for a, b in zip(again.uv, atlas.uv, strict=True))


def test_the_atlas_is_on_the_mesh_of_the_file(run):
    folder, atlas = run
    vertices, faces, _ = halves()
    shown, own, _ = load_mesh(folder / "parameterized.obj")
    assert np.allclose(shown, vertices, atol=1e-5)
    assert {tuple(sorted(f)) for f in own.tolist()} == {tuple(sorted(f)) for f in faces.tolist()}
    uv = nsm.surfaces.textures.read_uv(folder / "parameterized.obj")
    places = np.concatenate(atlas.uv)
    off = np.abs(uv.reshape(-1, 1, 2) - places[None]).max(axis=2).min(axis=1)
    assert off.max() < 1e-6


def test_the_glb_file_of_an_atlas_is_valid(run, valid_gltf):
    assert valid_gltf(run[0]) == {"parameterized.glb"}


def test_the_pattern_shows_every_chart_in_units_of_the_file(run):
    folder, atlas = run
    root = ElementTree.parse(folder / "pattern.svg").getroot()
    cuts = root.findall(".//{http://www.w3.org/2000/svg}path[@class='cut']")
    assert len(cuts) == 2
    drawn = []
    for cut in cuts:
        words = re.findall(r"\S+,\S+", cut.get("d"))
        points = np.array([[float(x) for x in word.split(",")] for word in words])
        drawn.append(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum())
    wanted = []
    for chart in atlas.charts:
        outline = chart.uv[topology.boundary_loops(chart.phi.surface.faces)[0]]
        length = np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1).sum()
        wanted.append(length / chart.phi.surface.scale)
    assert sorted(drawn) == pytest.approx(sorted(wanted), rel=1e-5)


def test_a_flattening_has_the_area_of_the_surface_where_the_energy_does_not_see_it(run):
    chart = run[1].charts[0]
    surface = chart.phi.surface
    wanted = topology.face_areas(surface.vertices, surface.faces).sum()

    def of(energy):
        return replace(chart, config={"energy": {"_target_": energy}})

    def area(uv):
        return topology.face_areas(np.pad(uv, ((0, 0), (0, 1))), surface.faces).sum()

    seen, unseen = of("nsm.energies.SymmetricDirichlet"), of("nsm.energies.Conformal")
    kept = area(seen.uv)
    assert kept == pytest.approx(area(of("mine.Conformal").uv))
    assert kept != pytest.approx(wanted, rel=1e-4)
    assert area(unseen.uv) == pytest.approx(wanted)
    in_units = area(in_file_units(unseen)) * surface.scale**2
    assert in_units == pytest.approx(wanted)
    with torch.no_grad():
        network = unseen.module()(torch.as_tensor(surface.uv))
    np.testing.assert_allclose(network, unseen.uv, atol=1e-5)
    assert unseen.certificate == seen.certificate


def test_given_edges_cut_one_chart():
    vertices, faces, _ = halves()
    # down a side, from pole to pole
    ends = [int(np.argmax(vertices @ d)) for d in ([0, 0, 1.0], [0, 0, -1.0])]
    graph = trimesh.Trimesh(vertices, faces, process=False).vertex_adjacency_graph
    path = networkx.shortest_path(graph, *ends)
    pairs = [[int(a), int(b)] for a, b in zip(path, path[1:], strict=False)]
    flat = nsm.parameterize((vertices, faces), seams=pairs, overrides=WORDS, progress=False)
    cut = flat.phi.surface
    assert {*cut.source_vertex[cut.seam_pairs.ravel()].tolist()} == set(path[1:-1])
    assert any(f"cut along {len(pairs)} given edges" in line for line in cut.log)


def test_seams_need_a_mesh(run):
    _, atlas = run
    with pytest.raises(NsmError) as refused:
        nsm.parameterize(atlas.charts[0].phi, seams=[[0, 1]], overrides=WORDS, progress=False)
    assert (refused.value.kind, refused.value.key) == ("conflicting_settings", "seams")


def flattened_from_poles():
    """The ball, and texture coordinates in which its halves are flattened from their poles."""
    vertices, faces, _ = halves()
    tilted = trimesh.transformations.euler_matrix(0.3, 0.2, 0.1)[:3, :3]  # no face is level
    x = vertices[faces] / 30 @ tilted
    sign = np.sign(x.mean(axis=1)[:, None, 2])
    radius = np.linalg.norm(x[:, :, :2], axis=2)
    angle = np.arccos(np.clip(sign * x[:, :, 2], -1, 1))
    uv = x[:, :, :2] * (angle / np.maximum(radius, 1e-9))[:, :, None] * [1.0, 0.6]
    return vertices, faces, uv / 8 + np.where(sign > 0, 0.25, 0.75)[:, :, None]


GIVEN = [
    *(word for word in WORDS if not word.startswith("surface.parameterization")),
    "surface.parameterization=given",
    "trainer.max_steps=0",
]


def test_each_island_starts_from_its_coordinates(tmp_path, capfd):
    vertices, faces, uv = flattened_from_poles()
    file = tmp_path / "ball (2).obj"
    TexturedMesh(vertices, faces, uv, np.full((4, 4, 3), 9, np.uint8)).export(file)
    shown = [word for word in GIVEN if word != "trainer.progress=false"]
    atlas = nsm.parameterize(file, overrides=shown, folder=tmp_path / "run")
    assert len(atlas.charts) == 2
    for chart in atlas.charts:
        surface = chart.phi.surface
        # in the plane of the file, but for the scale and place of the whole
        own = {tuple(sorted(f)): k for k, f in enumerate(faces.tolist())}
        ids, corners = surface.file_faces()
        at = [own[tuple(sorted(f))] for f in ids.tolist()]
        given = np.array(
            [uv[k][list(faces[k]).index(v)] for k, f in zip(at, ids, strict=True) for v in f]
        )
        start = chart.uv[corners.ravel()]
        moved, wanted = start - start.mean(axis=0), given - given.mean(axis=0)
        if np.linalg.det(np.linalg.lstsq(wanted, moved, rcond=None)[0]) < 0:
            wanted[:, 0] *= -1  # the half that is seen from within
        wanted *= np.linalg.norm(moved) / np.linalg.norm(wanted)
        assert np.abs(moved - wanted).max() < 0.02 * np.abs(wanted).max()
        both = [chart.metrics[name]["symmetric_dirichlet_median"] for name in ("given", "nsm")]
        assert both[1] == pytest.approx(both[0], rel=0.02)
        name = surface.name
        assert atlas.metrics[f"{name}, given UV"] == chart.metrics["given"]
    printed = capfd.readouterr().out
    assert printed.count("given UV") == 2 and "ball (2)-1" in printed
    again = nsm.load(tmp_path / "run")
    assert all(np.array_equal(a.uv, b.uv) for a, b in zip(again.charts, atlas.charts, strict=True))


@pytest.mark.parametrize(
    ("what", "kind"),
    [({"seams": [[0, 1]]}, "conflicting_settings"), ({"phi": "hemisphere"}, "missing_uv")],
)
def test_what_does_not_go_with_given_coordinates_is_refused(what, kind):
    with pytest.raises(NsmError) as refused:
        nsm.parameterize(**{"phi": "hemisphere", **what}, overrides=GIVEN, progress=False)
    assert refused.value.kind == kind


def test_the_viewer_shows_all_charts_and_their_atlas(run):
    folder, _ = run
    atlas = nsm.load(folder)
    vertices, _, _ = halves()
    scene = scene_of(atlas)
    source, target = scene.shapes
    assert np.allclose(source.coordinates, vertices[source.numbers], atol=1e-5)
    assert len(source.seam) > 10  # where the halves meet
    face = np.arange(0, len(source.faces), 7)
    places = Places(face, np.full((len(face), 3), 1 / 3))
    assert np.array_equal(scene.corresponding(0, places).face, face)
    assert np.array_equal(scene.corresponding(1, places).face, face)
    # the flattening is nearly isometric, in one unit for all charts
    assert np.median(scene.energies["symmetric dirichlet"]) < 6
    assert np.ptp(target.vertices @ scene.frame[2]) < 1e-9  # it faces the viewer
    for name in scene.colourings:
        for paint in scene.paint(name):
            values = paint.colours if paint.checkerboard is None else paint.checkerboard
            assert len(values) == len(source.vertices)
    pytest.importorskip("viser", reason="needs nsm[view]")
    with serving(atlas, "127.0.0.1", 0) as (viewer, _):
        ray = scene.camera[0], source.vertices[0] + scene.offsets[0] - scene.camera[0]
        viewer.on_click(SimpleNamespace(ray_origin=ray[0], ray_direction=ray[1]))
        assert "atlas" in viewer._list.content
