"""The viewer: picking and colours against closed forms, and clicks on a running server."""

import json
import socket
import struct
import time
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from tiny import NETWORK, stirred

from nsm.domains import Disc, Surface
from nsm.errors import NsmError
from nsm.maps import DiscMap, NeuralMap, Rotated
from nsm.maps.activations import Tanh
from nsm.results import (
    NeuralSurface,
    Parameterization,
    SurfaceCollection,
    SurfaceMap,
    save_surface,
)
from nsm.results.analytic import analytic_surface
from nsm.results.render import UP_AXES
from nsm.results.view.colours import as_lab, distinct_colours
from nsm.results.view.glb import painted_glb
from nsm.results.view.picking import hit, pick, pick_at
from nsm.results.view.scene import PLAIN, POSITION, Paint, scene_of
from nsm.surfaces.location import Places, locate
from nsm.surfaces.shapes import ring_mesh
from nsm.surfaces.topology import boundary_loops


def turned(angle: float) -> Rotated:
    """The rotation of the disc by an angle: a network starts as the identity."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = torch.tensor([[c, -s], [s, c]], dtype=torch.float32)
    h = DiscMap(NeuralMap(DiscMap.network_out_dim, width=4, depth=1, activation=Tanh()))
    return Rotated(h, rotation).eval().requires_grad_(False)


@pytest.fixture(scope="module")
def surfaces():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Disc, "mesh", lambda self: ring_mesh(12))
        shapes = ("sphere_cap", "paraboloid", "cone")
        return [analytic_surface({"name": name}, "disc") for name in shapes]


@pytest.fixture(scope="module")
def f(surfaces) -> SurfaceMap:
    landmarks = np.array([[0, 0], [30, 30], [60, 60]])
    return SurfaceMap(surfaces[0], surfaces[1], turned(0.7), landmarks)


@pytest.fixture(scope="module")
def closed() -> NeuralSurface:
    ball = trimesh.creation.icosphere(subdivisions=2)
    surface = Surface.from_arrays(3 * ball.vertices + 5, ball.faces, parameterization="tutte")

    class Exact(torch.nn.Module):
        def forward(self, uv):
            points = locate(uv.numpy(), surface.uv, surface.faces)
            return torch.from_numpy(points.take(surface.vertices, surface.faces))

    return NeuralSurface(surface, Exact())


def towards(scene, side: int, vertex: int, shown=None):
    """A ray from the camera to a point near a vertex of a shape, in the world."""
    shape = scene.shapes[side]
    face = np.flatnonzero((shape.faces == vertex).any(axis=1))[:1]
    vertices = shape.vertices if shown is None else shown[side]
    point = Places(face, np.array([[0.5, 0.3, 0.2]])).take(vertices, shape.faces)[0]
    origin = scene.camera[0]
    return origin, point + scene.offsets[side] - origin


def seen(scene, side: int) -> int:
    """A vertex of a shape that nothing hides from the camera."""
    return int((scene.shapes[side].vertices @ scene.frame[2]).argmax())


def still(scene):
    return scene.source.vertices, scene.target.vertices


def test_a_ray_hits_the_nearest_triangle():
    sheets = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 2], [4, 0, 2], [0, 4, 2.0]])
    faces = np.array([[0, 1, 2], [3, 5, 4]])  # the second has the opposite orientation
    distance, place = hit(np.array([1, 1, 5.0]), np.array([0, 0, -2.0]), sheets, faces)
    assert (distance, place.face[0]) == (1.5, 1)
    assert place.take(sheets, faces)[0] == pytest.approx([1, 1, 2])
    distance, place = hit(np.array([1, 1, -1.0]), np.array([0, 1, 1.0]), sheets, faces)
    assert (distance, place.face[0]) == (1.0, 0)
    assert place.weights[0] == pytest.approx([0.25, 0.25, 0.5])
    assert hit(np.array([1, 1, 5.0]), np.array([0, 0, 1.0]), sheets, faces) is None
    assert hit(np.array([3, 3, 5.0]), np.array([0, 0, -1.0]), sheets, faces) is None
    assert hit(np.array([-1, 1, 0.0]), np.array([1.0, 0, 0]), sheets, faces) is None  # edge-on


def test_rays_through_edges_hit(closed):
    s = closed.surface
    middle = s.vertices[s.faces].mean(axis=1).mean(axis=0)
    edges = s.vertices[s.faces[:, :2]].mean(axis=1)
    for point in edges[:200]:
        assert hit(middle + 9 * (point - middle), middle - point, s.vertices, s.faces)


@pytest.mark.parametrize("side", [0, 1])
def test_a_picked_point_and_its_image_correspond(f, side):
    scene = scene_of(f)
    found = pick(scene, *towards(scene, side, seen(scene, side)), still(scene))
    assert found.side == side
    ends = zip(found.places, scene.shapes, strict=True)
    at = [place.take(shape.vertices, shape.faces)[0] for place, shape in ends]
    origin, direction = towards(scene, side, seen(scene, side))
    assert at[side] + scene.offsets[side] == pytest.approx(origin + direction, abs=1e-9)
    assert f(found.coordinates[0][None])[0] == pytest.approx(found.coordinates[1], abs=1e-9)
    assert f.planar(found.uv[:1])[0] == pytest.approx(found.uv[1], abs=1e-9)
    # the displayed target is only translated
    t = f.target.surface
    posed = f.aligned((found.coordinates[1][None] - t.center) * t.scale)[0]
    assert at[1] - posed == pytest.approx(scene.target.vertices[0] - f.aligned(t.vertices)[0])


def test_a_ray_past_both_shapes_picks_nothing(f):
    scene = scene_of(f)
    assert pick(scene, scene.camera[0], scene.frame[1], still(scene)) is None


def test_the_nearer_of_two_shapes_in_line_is_picked(f):
    scene = scene_of(f)
    right = scene.frame[0]
    for side, sign in ((0, 1), (1, -1)):
        vertices = scene.shapes[side].vertices
        point = vertices[int((vertices @ right * -sign).argmax())] * 0.98
        found = pick(
            scene, scene.offsets[side] + point - 9 * sign * right, sign * right, still(scene)
        )
        assert found.side == side


def test_a_morphed_shape_is_picked_where_it_is(f):
    scene = scene_of(f)
    shown = scene.morph(1.0), scene.target.vertices
    assert scene.morph(0.0) == pytest.approx(scene.source.vertices)
    assert shown[0] == pytest.approx(scene.image)
    ray = towards(scene, 0, seen(scene, 0), shown)
    found = pick(scene, *ray, shown)
    at = found.places[0].take(shown[0], scene.source.faces)[0]
    assert at + scene.offsets[0] == pytest.approx(sum(ray), abs=1e-9)
    # now it has the shape of the target: a point is its own image, up to the triangles' chords
    image = found.places[1].take(scene.target.vertices, scene.target.faces)[0]
    assert np.linalg.norm(at - image) < 0.02


def test_seams_are_the_edges_that_were_cut(closed, f):
    shape = scene_of(closed).source
    (loop,) = boundary_loops(shape.faces)
    assert 2 * len(shape.seam) == len(loop)
    assert set(shape.seam.ravel()) <= set(loop)
    assert len(scene_of(f).source.seam) == 0
    # the normals are continuous across them
    normals = shape.normals(shape.vertices)
    assert normals[shape.seam_pairs[:, 0]] == pytest.approx(normals[shape.seam_pairs[:, 1]])
    outward = shape.vertices / np.linalg.norm(shape.vertices, axis=1)[:, None]
    assert (normals * outward).sum(axis=1).min() > 0.99


def test_coordinates_are_in_the_units_of_the_file(closed):
    scene = scene_of(closed)
    found = pick_at(scene, 0, Places(np.array([7]), np.array([[1.0, 0, 0]])))
    assert np.linalg.norm(found.coordinates[0] - 5) == pytest.approx(3)


def test_a_point_and_its_image_have_one_colour(f):
    scene = scene_of(f)
    board = scene.paint("checkerboard of the target")
    assert board[0].checkerboard is f.image_uv
    # except at the boundary, where the chords of source and target differ
    assert board[1].checkerboard == pytest.approx(f.target.surface.uv, abs=1e-3)
    source = scene.paint("checkerboard of the source")[1].checkerboard
    assert source == pytest.approx(f.source_uv)
    for name in scene.colourings:
        for paint, shape in zip(scene.paint(name), scene.shapes, strict=True):
            values = paint.checkerboard if paint.colours is None else paint.colours
            assert len(values) == len(shape.vertices) and np.isfinite(values).all()
    colours = scene.paint(POSITION)
    at = scene.corresponding(1, Places(np.array([40]), np.array([[0.2, 0.3, 0.5]])))
    there = Places(np.array([40]), np.array([[0.2, 0.3, 0.5]])).take(
        colours[1].colours, scene.target.faces
    )
    assert there == pytest.approx(at.take(colours[0].colours, scene.source.faces), abs=0.02)


def test_no_triangle_of_a_closed_target_goes_around_the_domain():
    ends = []
    for k in range(2):
        ball = trimesh.creation.icosphere(subdivisions=3)
        turned = trimesh.transformations.rotation_matrix(k, [1, 2, 3])[:3, :3]
        points = ball.vertices @ turned * [1, 1, 1.3]
        surface = Surface.from_arrays(points, ball.faces, domain="orbifold")
        ends.append(NeuralSurface(surface, stirred(NeuralMap(out_dim=3, **NETWORK))))
    h = stirred(ends[0].surface.domain.equivariant(NeuralMap(out_dim=2, **NETWORK)))
    scene = scene_of(SurfaceMap(*ends, h, np.zeros((0, 2), int)))
    for name in ("checkerboard of the source", "checkerboard of the target"):
        own, carried = (paint.checkerboard for paint in scene.paint(name))
        faces = scene.target.faces
        assert carried.shape == (len(faces), 3, 2)
        assert np.abs(carried - carried[:, :1]).max() < 0.7  # the domain is 2 wide
        values = scene.transferred(own)[faces].reshape(-1, 2)
        same = scene.lift(carried.reshape(-1, 2), values)
        np.testing.assert_allclose(same, values, atol=1e-9)
        data = painted_glb(scene.target, scene.target.vertices, scene.paint(name)[1])
        assert len(data) > 3 * len(faces) * 8 * 4  # a vertex for each corner


def test_colours_follow_the_scale(f):
    scene = scene_of(f)
    scale = scene.scale("symmetric dirichlet")
    assert scale == (4, 20, True)
    low, high = scale.colours(np.array([3.0, 4.0])), scale.colours(np.array([20.0, 1e3]))
    assert low[0] == pytest.approx(low[1]) and high[0] == pytest.approx(high[1])
    assert scale.bar(3)[1] == pytest.approx(scale.colours(np.array([80**0.5]))[0], abs=0.01)
    assert scene.scale(PLAIN) is None
    values = scene.energies["area"]
    low, high, log = scene.scale("area")
    assert not log and (low, high) == pytest.approx(np.percentile(values, [1, 98]))


@pytest.mark.parametrize("up", UP_AXES)
def test_the_shapes_stand_side_by_side_before_the_camera(f, closed, up):
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    for scene in (scene_of(f, up), scene_of(closed, up)):
        assert np.linalg.det(scene.frame) == pytest.approx(1)
        assert scene.frame[1] @ axis > 0.5
        right = [
            (s.vertices + o) @ scene.frame[0]
            for s, o in zip(scene.shapes, scene.offsets, strict=True)
        ]
        assert right[0].max() < right[1].min()
        place, aim = scene.camera
        assert (place - aim) / np.linalg.norm(place - aim) == pytest.approx(scene.frame[2])
        for shape, offset in zip(scene.shapes, scene.offsets, strict=True):
            x, y, z = ((shape.vertices + offset - place) @ scene.frame.T).T
            assert (z < 0).all()
            assert np.abs(y / z).max() < np.tan(0.5 * scene.field_of_view)
            assert np.abs(x / z).max() < 1.6 * np.tan(0.5 * scene.field_of_view)


def test_a_flattening_lies_flat_before_the_viewer(surfaces):
    h = turned(0.4)
    scene = scene_of(Parameterization(surfaces[1], h))
    assert scene.target.normals(scene.target.vertices) == pytest.approx(
        np.broadcast_to(scene.frame[2], scene.target.vertices.shape)
    )
    place = Places(np.array([11]), np.array([[0.2, 0.5, 0.3]]))
    found = pick_at(scene, 0, place)
    assert found.coordinates[1] == pytest.approx(
        h(torch.tensor(found.uv[:1]).float())[0].numpy(), abs=1e-5
    )
    back = pick_at(scene, 1, place)
    assert back.coordinates[0] == pytest.approx(found.coordinates[0], abs=1e-9)
    board = scene.paint("checkerboard of the plane")[1].checkerboard
    assert np.abs(board).max() == pytest.approx(1, abs=1e-6)


def test_an_error_is_that_of_the_neural_surface(surfaces):
    class Shifted(torch.nn.Module):
        def forward(self, uv):
            return surfaces[0].map(uv) + torch.tensor([0, 0, 0.1])

    s = surfaces[0].surface
    scene = scene_of(NeuralSurface(s, Shifted()))
    found = pick_at(scene, 0, Places(np.array([3]), np.array([[0.2, 0.5, 0.3]])))
    percent = 10 / s.bounding_box_diagonal
    assert found.values["distance, % of diagonal"] == pytest.approx(percent, abs=1e-4)
    assert found.coordinates[1] - found.coordinates[0] == pytest.approx([0, 0, 0.1], abs=1e-6)


def test_a_mesh_for_the_browser_has_its_colours_and_normals(closed):
    shape = scene_of(closed).source
    grey = Paint(np.full((len(shape.vertices), 3), 0.5), None)
    for paint in (grey, Paint(None, shape.uv)):
        data = painted_glb(shape, shape.vertices, paint)
        length, kind = struct.unpack("<I4s", data[12:20])
        gltf = json.loads(data[20 : 20 + length])
        (part,) = gltf["meshes"][0]["primitives"]
        own = "COLOR_0" if paint.checkerboard is None else "TEXCOORD_0"
        assert set(part["attributes"]) == {"POSITION", "NORMAL", own}
        material = gltf["materials"][part["material"]]
        assert material["doubleSided"]
        textured = "baseColorTexture" in material["pbrMetallicRoughness"]
        assert textured == (paint.checkerboard is not None)
    mesh = next(
        iter(trimesh.load(trimesh.util.wrap_as_stream(data), file_type="glb").geometry.values())
    )
    assert mesh.visual.uv == pytest.approx(0.5 * (shape.uv + 1), abs=1e-6)


@pytest.fixture(scope="module")
def served(f):
    pytest.importorskip("viser", reason="needs nsm[view]")
    from nsm.results.view import serving

    with serving(f, "127.0.0.1", 0) as (viewer, address):
        yield viewer, address


def click(viewer, side: int) -> None:
    origin, direction = towards(viewer.scene, side, seen(viewer.scene, side), viewer.shown)
    viewer.on_click(SimpleNamespace(ray_origin=tuple(origin), ray_direction=tuple(direction)))


def test_a_click_marks_the_point_and_its_image(served, f):
    viewer, address = served
    with urllib.request.urlopen(address, timeout=20) as page:
        assert page.status == 200 and b"<html" in page.read().lower()
    click(viewer, 0)
    source, target = (np.array(marker.position) for marker in viewer.markers[1])
    s, t = f.source.surface, f.target.surface
    point = source - viewer.scene.offsets[0] - (viewer.scene.source.vertices - s.vertices)[0]
    image = f(point[None] / s.scale + s.center)
    posed = f.aligned((image - t.center) * t.scale)[0]
    moved = (viewer.scene.target.vertices - f.aligned(t.vertices))[0] + viewer.scene.offsets[1]
    assert target == pytest.approx(posed + moved, abs=1e-6)

    # the source moves under its marker
    viewer.morph.value = 1.0
    viewer._show_morph()
    at = viewer.picks[1].places[0].take(viewer.scene.image, s.faces)[0]
    assert np.array(viewer.markers[1][0].position) == pytest.approx(
        at + viewer.scene.offsets[0], abs=1e-6
    )
    viewer.morph.value = 0.0
    viewer._show_morph()
    for _ in range(5):
        click(viewer, 1)
    assert list(viewer.markers) == [2, 3, 4, 5, 6]
    latest = viewer._list.content.split("\n\n")[0].splitlines()
    assert latest[0].startswith("**6** | vertex") and latest[2].startswith("sphere\\_cap |")
    assert latest[3].startswith("cone (picked)".replace("cone", t.name))
    for side, line in enumerate(latest[2:4]):
        number, corner = int(line.split("|")[1]), viewer.picks[6].coordinates[side]
        mesh = (s, t)[side]
        vertices = mesh.vertices[mesh.cut_vertex] / mesh.scale + mesh.center
        near = np.sort(np.linalg.norm(vertices - corner, axis=1))
        assert np.linalg.norm(vertices[number] - corner) <= near[2] + 1e-9
    viewer._clear_picks()
    assert viewer.markers == {} and viewer._list.content == ""
    viewer.on_click(SimpleNamespace(ray_origin=(0, 0, 99.0), ray_direction=(0, 0, 1.0)))
    assert viewer.picks == {}


def test_every_choice_of_the_panel_can_be_shown(served):
    viewer, _ = served
    for name in viewer.scene.colourings:
        viewer.colouring.value = name
        viewer._show_shapes()
        assert viewer._bar.visible == (viewer.scene.scale(name) is not None)
    viewer.landmarks.value, viewer.seams.value = True, True
    viewer._show_overlays()
    names = {mark.name for mark in viewer._overlays}
    assert names == {"/source/landmarks", "/target/landmarks"}  # open surfaces have no seam
    viewer.up.value = "z"
    viewer._rebuild()
    assert viewer.scene.frame[1] @ [0, 0, 1] > 0.5


def test_seams_are_drawn_on_both_shapes(closed):
    pytest.importorskip("viser", reason="needs nsm[view]")
    from nsm.results.view import serving

    g = SurfaceMap(closed, closed, turned(0.3), np.zeros((0, 2), dtype=np.int64))
    with serving(g, "127.0.0.1", 0) as (viewer, _):
        viewer.seams.value = True
        viewer._show_overlays()
        names = {mark.name for mark in viewer._overlays}
        assert names == {"/source/seam", "/target/seam", "/target/image"}


def test_any_pair_of_a_collection_is_chosen(surfaces):
    pytest.importorskip("viser", reason="needs nsm[view]")
    from nsm.results.view import serving

    maps = [turned(angle) for angle in (0.0, 0.5, 1.3)]
    group = SurfaceCollection(surfaces, maps, np.zeros((0, 3), dtype=np.int64))
    with serving(group, "127.0.0.1", 0) as (viewer, _):
        click(viewer, 0)
        viewer.ends[1].value = viewer.ends[1].options[2]
        viewer._choose_pair(1)
        assert [s.name for s in viewer.scene.shapes] == ["sphere_cap", "cone"]
        assert viewer.picks == {}
        click(viewer, 0)
        found = viewer.picks[1]
        assert group.pair(0, 2)(found.coordinates[0][None])[0] == pytest.approx(
            found.coordinates[1], abs=1e-9
        )
        # choosing the same surface twice swaps the two
        viewer.ends[0].value = viewer.ends[0].options[2]
        viewer._choose_pair(0)
        assert [s.name for s in viewer.scene.shapes] == ["cone", "sphere_cap"]
        assert [end.value for end in viewer.ends] == ["2: cone", "0: sphere_cap"]


def test_the_command_prints_the_address_and_ends_without_an_error(
    here, surfaces, tmp_path, monkeypatch
):
    pytest.importorskip("viser", reason="needs nsm[view]")
    save_surface(tmp_path / "run", surfaces[0])

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("nsm.commands.view.time.sleep", interrupt)
    result = here("view", "run", "--port", "0")
    assert result.returncode == 130
    (line,) = result.stdout.splitlines()
    assert line.startswith("run: http://127.0.0.1:") and result.stderr == ""
    port = int(line.split(":")[3].split()[0])
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", port), timeout=1)


@pytest.mark.parametrize(
    ("host", "port", "error"),
    [
        ("127.0.0.1", None, ("port_in_use", "port")),
        ("127.0.0.1", 70000, ("out_of_range", "port")),
        ("192.0.2.1", 0, ("address_not_available", "host")),
    ],
)
def test_addresses_that_cannot_be_used(f, host, port, error):
    pytest.importorskip("viser", reason="needs nsm[view]")
    from nsm.results.view import serving

    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = busy.getsockname()[1] if port is None else port
        with pytest.raises(NsmError) as caught, serving(f, host, port):
            pass
    assert (caught.value.kind, caught.value.key) == error


@pytest.mark.parametrize(
    "words", [["elsewhere"], ["elsewhere", "--port", "http"], ["elsewhere", "--trust"], []]
)
def test_wrong_words_are_one_line_and_status_2(here, words):
    pytest.importorskip("viser", reason="needs nsm[view]")
    result = here("view", *words)
    assert (result.returncode, result.stdout) == (2, "")
    assert len(result.stderr.splitlines()) == 1


def test_trusted_modules_reach_the_loader(monkeypatch):
    pytest.importorskip("viser", reason="needs nsm[view]")
    from nsm.commands import view

    class Loaded(Exception):
        pass

    def load(folder, trust=()):
        raise Loaded(str(folder), list(trust))

    monkeypatch.setattr("nsm.result_folders.load", load)
    for words in (["--trust", "a.b", "--trust", "c"], ["--trust=a.b, c"]):
        with pytest.raises(Loaded) as caught:
            view.main(["run", *words])
        assert caught.value.args == ("run", ["a.b", "c"])


def test_without_viser_the_command_names_the_extra(here, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    result = here("view", "anything")
    assert result.returncode == 2
    assert "nsm[view]" in result.stderr


def test_the_page_cannot_publish_the_server(served):
    viewer, _ = served
    started = time.monotonic()
    assert viewer.server.request_share_url() is None
    assert time.monotonic() - started < 1


def test_colours_of_landmarks_are_told_apart():
    few, many = distinct_colours(8), distinct_colours(24)
    assert (many[:8] == few).all()  # a further landmark changes no other's colour
    lab = as_lab(many / 255)
    apart = np.linalg.norm(lab[:, None] - lab[None], axis=-1)[~np.eye(24, dtype=bool)]
    assert apart.min() > 20  # ten times what is just noticed
    white, red = as_lab(np.array([[1.0, 1, 1], [1, 0, 0]]))
    assert white == pytest.approx([100, 0, 0], abs=0.02)
    assert red == pytest.approx([53.24, 80.09, 67.20], abs=0.02)  # tabulated


def test_names_of_files_stay_text_in_the_panel():
    from nsm.results.view.server import _cell

    assert _cell("cat|<b>*x*") == r"cat\|\<b\>\*x\*"
