"""Parts of shapes mapped into whole ones: the truth of a piece, and what users get of its map."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import trimesh
from domains.orbifold.shapes import limbs

import nsm
from nsm.correspondence.distances import edge_distances
from nsm.errors import NsmError
from nsm.pipeline.parts import relative_scale
from nsm.results.textures import GREY
from nsm.results.view.scene import scene_of
from nsm.surfaces.topology import face_areas
from nsm.surfaces.validation import Repairs, clean

FAST = [
    "experiment=fast",
    "trainer.threads=1",
    "trainer.max_steps=3",
    "optimizer.levels=[8,16]",
    "optimizer.steps=[1]",
    "data.points=[512,1024]",
    "data.steps=[1]",
    "data.held_out=256",
    "trainer.log_pictures=0",
    "phi.processes=1",
    'phi.overrides=["experiment=quick","trainer.threads=1","encoding.resolutions=[16]",'
    '"trainer.max_steps=0"]',
]
SCALE = 2.5  # of the piece's file


def cut(subdivisions=2):
    """A shape, its lower part, the shape's vertices that the part's own are, and four of these."""
    vertices, faces, _ = limbs(subdivisions)
    kept = faces[vertices[faces].mean(axis=1)[:, 2] < 0.35]
    mesh = clean(vertices, kept, repairs=Repairs("largest"))
    marks = [int(edge_distances(mesh.vertices, mesh.faces, [0])[0].argmax())]
    while len(marks) < 4:
        away = edge_distances(mesh.vertices, mesh.faces, marks).min(axis=0)
        marks.append(int(away.argmax()))
    return (vertices, faces), (mesh.vertices, mesh.faces), mesh.source_vertex, marks


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run that maps the part, in other units and another place, into the shape it is of."""
    whole, (points, faces), number, marks = cut()
    folder = tmp_path_factory.mktemp("part") / "run"
    piece = SCALE * points + [5.0, 0.0, -3.0]
    pairs = [[v, int(number[v])] for v in marks]
    with pytest.MonkeyPatch.context() as patch:  # large pictures take most of the time
        for name in ("pair_pictures.PANEL", "pair_pictures._MORPH"):
            patch.setattr(f"nsm.results.{name}", 96)
        patch.setattr("nsm.results.reliability.PANEL", 96)
        ends = (piece, faces), whole, pairs
        f = nsm.map_pair(*ends, overrides=FAST, folder=folder, progress=False)
    return folder, f, (piece, faces), whole, number


def test_a_piece_goes_where_it_was_cut_from(made):
    """In other units, which distances between landmarks tell, with hardly any distortion."""
    _, f, (piece, _), (vertices, faces), number = made
    off = np.linalg.norm(f(piece) - vertices[number], axis=1)
    assert off.mean() < 0.02 * np.sqrt(face_areas(vertices, faces).sum())
    assert f.metrics["symmetric_dirichlet_median"] < 4.05
    area = face_areas(*made[2]).sum() / SCALE**2
    whole = face_areas(vertices, faces).sum()
    assert f.metrics["covered_percent"] == pytest.approx(100 * area / whole, abs=2)


def test_it_is_certified_to_be_injective_into_the_target(made):
    folder, f, _, _, _ = made
    assert f.certificate["certified"]
    assert f.statement == "injective into the target"
    summary = json.loads((folder / "metrics.json").read_text())
    assert summary["certified"] and summary["statement"] == f.statement
    assert 20 < summary["caps_percent"] < 50
    # the middles of the piece's triangles, where they go, lie in the image of no other triangle
    s, part = f.source.surface, f.part
    middles = part.image_uv[part.source.surface.faces].mean(axis=1)
    found = s.domain.locate(middles, f.image_uv, s.faces).face
    assert np.array_equal(found, np.flatnonzero(~s.caps))


def test_exports_have_the_faces_of_the_file(made):
    folder, f, (piece, faces), _, _ = made
    for file in ("mapped.obj", "source_with_target_uv.obj", "morph/03.obj"):
        mesh = trimesh.load(folder / file, process=False)
        assert np.array_equal(mesh.faces, faces), file
        assert len(mesh.vertices) == len(piece)
    image = trimesh.load(folder / "mapped.obj", process=False).vertices
    assert np.abs(image - f(piece)).max() < 1e-5
    for name in ("transfer", "distortion", "morph", "reliability"):
        assert (folder / f"{name}.png").exists()


def test_what_nothing_goes_to_has_no_preimage(made):
    """Back from the target: there and back is the identity, and the rest is said to be none."""
    _, f, (piece, faces), (vertices, target_faces), _ = made
    assert np.abs(f.inverse(f(piece)) - piece).max() < 1e-6
    back = f.inverse(vertices)
    none = np.isnan(back).any(axis=1)
    high = vertices[:, 2] > 0.7
    assert none[high].all() and not none[vertices[:, 2] < 0].any()
    tensor = f.inverse(torch.from_numpy(vertices))
    assert np.array_equal(torch.isnan(tensor).any(dim=1).numpy(), none)
    face, weights = f.correspondences(back=True)
    assert np.array_equal(face < 0, none) and np.isnan(weights[none]).all()
    values = f.transfer(piece)
    assert np.abs(values[~none] - back[~none]).max() < 1e-6 and np.isnan(values[none]).all()
    labels = f.transfer(np.arange(len(piece), dtype=np.uint8))
    assert (labels[none] == -1).all() and (labels[~none] >= 0).all()
    assert not f.transfer(np.ones(len(piece), dtype=bool))[none].any()
    product = f.matrix() @ piece
    assert np.abs(product[~none] - values[~none]).max() < 1e-6 and (product[none] == 0).all()
    forth = f.transfer(vertices, back=True)
    assert np.abs(forth - f(piece)).max() < 1e-6
    stored = np.load(made[0] / "correspondences.npz")
    assert np.array_equal(stored["target_to_source_face"] < 0, none)


def test_it_is_the_same_after_loading(made):
    folder, f, (piece, _), _, _ = made
    again = nsm.load(folder)
    assert np.array_equal(again.source.surface.caps, f.source.surface.caps)
    assert np.abs(again(piece) - f(piece)).max() < 1e-6
    assert again.certificate == f.certificate and again.statement == f.statement


def test_the_part_is_the_surface_without_caps(made):
    _, f, (piece, faces), _, _ = made
    s = f.source.surface
    part = s.part
    assert part.part is part and f.part.part is f.part
    assert len(part.faces) == len(faces) == (~s.caps).sum()
    assert (part.source_vertex >= 0).all()
    points = f.source.in_original_units(part.vertices)
    assert np.abs(points - piece[part.source_vertex]).max() < 1e-9
    assert np.array_equal(part.source_vertex[part.cut_vertex], np.arange(len(piece)))
    assert np.array_equal(s.uv[s.of_part], part.uv)


def test_the_viewer_shows_the_part_and_leaves_the_rest_grey(made):
    _, f, (piece, _), _, _ = made
    scene = scene_of(f)
    assert len(scene.source.vertices) == len(f.part.image) >= len(piece)
    assert np.array_equal(scene.unreached, f.unreached) and scene.unreached.any()
    on_target = scene.paint("position on the source")[1].colours
    assert (on_target[scene.unreached] == GREY).all()
    assert (on_target[~scene.unreached] != GREY).any(axis=1).all()


def test_the_scale_is_that_of_distances_between_landmarks():
    whole, (points, faces), number, marks = cut()
    ids = np.array([marks, number[marks]])
    for scale in (0.1, 3.0):
        found = relative_scale((scale * points, faces), whole, ids)
        assert found == pytest.approx(scale, rel=0.05)


@pytest.mark.parametrize("more", [["domain=disc"], ["experiment=paper"]])
def test_a_part_is_refused_on_a_disc(more):
    whole, piece, number, marks = cut()
    with pytest.raises(NsmError) as refused:
        nsm.map_pair(piece, whole, [[v, int(number[v])] for v in marks], overrides=more)
    assert (refused.value.kind, refused.value.key) == ("wrong_topology", "target")


def test_a_whole_shape_is_not_mapped_into_a_part():
    whole, piece, number, marks = cut()
    for more in ([], ["domain=orbifold"]):
        with pytest.raises(NsmError) as refused:
            nsm.map_pair(whole, piece, [[int(number[v]), v] for v in marks], overrides=more)
        assert refused.value.kind == "wrong_topology"


@pytest.mark.parametrize(
    "landmarks, kind",
    [("auto", "wrong_topology"), (None, "too_few_landmarks"), ([], "too_few_landmarks")],
)
def test_a_part_needs_landmarks(landmarks, kind):
    whole, piece, _, _ = cut()
    with pytest.raises(NsmError) as refused:
        nsm.map_pair(piece, whole, landmarks, overrides=FAST, progress=False)
    assert (refused.value.kind, refused.value.key) == (kind, "landmarks")


def test_a_part_is_not_mapped_into_a_closed_surface_in_closed_form():
    with pytest.raises(NsmError) as refused:
        nsm.map_pair(cut()[1], {"name": "ellipsoid"}, overrides=FAST, progress=False)
    assert (refused.value.kind, refused.value.key) == ("wrong_topology", "target")
