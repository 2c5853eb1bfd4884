"""The editor of landmarks: clicks, drags and buttons on a running server, by their handlers.

The handlers are those that a browser's events call; a browser itself is not part of these tests.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from nsm.correspondence import CollectionProposal
from nsm.correspondence.landmark_list import LandmarkList
from nsm.correspondence.preview import previewed
from nsm.errors import NsmError
from nsm.surfaces.landmark_files import read_names, read_pairs
from nsm.surfaces.shapes import sphere

DIRECTIONS = np.array([[1, 0, 0.2], [-1, 1, 0], [-0.8, -0.7, 0.1], [0.1, -0.2, 1], [0.3, -0.9, -1]])


def star(stretch=1.0):
    """A ball with five limbs, and the vertices at their tips."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    points = np.array(ball.vertices)
    along = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    angle = np.arccos(np.clip(points @ along.T, -1, 1))
    radius = 1 + np.exp(-((angle / 0.4) ** 2)) @ (stretch * np.array([2.6, 1.9, 1.3, 1.6, 2.2]))
    return radius[:, None] * points, np.array(ball.faces), angle.argmin(axis=0)


@pytest.fixture
def edited(tmp_path):
    pytest.importorskip("viser", reason="needs nsm[view]")
    from nsm.results.view import EditedShape, LandmarkEditor, running

    shapes = []
    for k, stretch in enumerate((1.0, 1.1)):
        vertices, faces, _ = star(stretch)
        # numbers of the files are others: something was removed there
        shapes.append(EditedShape("ab"[k], vertices, faces, np.arange(len(vertices)) + 100 * k))
    with running("nsm landmarks", "127.0.0.1", 0) as (server, _):
        yield LandmarkEditor(shapes, LandmarkList(2), tmp_path / "pairs.json", server)


def click(editor, side, vertex):
    """A click from outside on a point of a triangle very near to a vertex."""
    shape, placed = editor.shapes[side], editor.placed[side]
    face = shape.faces[np.flatnonzero((shape.faces == vertex).any(axis=1))[0]]
    point = 0.9 * placed[vertex] + 0.1 * placed[face].mean(axis=0)
    middle = placed.mean(axis=0)
    origin = middle + 1.2 * (point - middle)  # nearer than the other shape
    editor.on_click(SimpleNamespace(ray_origin=origin, ray_direction=point - origin))


def vertices(editor):
    return [mark.vertices for mark in editor.landmarks.landmarks]


def test_clicks_drags_and_buttons(edited):
    editor, tips = edited, star()[2].tolist()
    click(editor, 0, tips[0])
    assert vertices(editor) == [(tips[0], None)] and list(editor.markers) == [(0, 0)]
    click(editor, 1, tips[0])
    assert vertices(editor) == [(tips[0], tips[0])]
    colours = [tuple(editor.markers[0, side].color) for side in (0, 1)]
    assert colours[0] == colours[1]
    for side in (0, 1):
        at = np.array(editor.markers[0, side].position)
        assert at == pytest.approx(editor.placed[side][tips[0]], abs=1e-6)
    click(editor, 0, tips[1])
    click(editor, 1, tips[2])  # a mistake
    assert editor.selected == 1 and len(editor.handles) == 2
    editor.drag(1, 1, editor.placed[1][tips[1]] + 0.001)
    assert vertices(editor)[1] == (tips[1], tips[1])
    editor.drag(1, 1, editor.placed[1][tips[0]])  # is another's
    assert vertices(editor)[1] == (tips[1], tips[1]) and "another" in editor.message.content
    # a click on a marker selects; nothing new
    click(editor, 0, tips[0])
    assert editor.selected == 0 and len(vertices(editor)) == 2
    editor.name.value = "nose"
    editor.rename()
    assert editor.landmarks.landmarks[0].name == "nose" and "**nose**" in editor.list.content
    editor.delete()
    assert vertices(editor) == [(tips[1], tips[1])] and len(editor.markers) == 2
    editor.undo()
    assert len(vertices(editor)) == 2 and len(editor.markers) == 4
    # past both shapes
    up = SimpleNamespace(ray_origin=(0, 9, 0), ray_direction=(0, 1, 0))
    editor.on_click(up)
    assert len(vertices(editor)) == 2
    editor.save()
    assert "2 landmarks saved" in editor.message.content
    assert read_pairs(editor.file) == (tips[:2], [t + 100 for t in tips[:2]])
    assert read_names(editor.file) == ["nose", "2"]


def test_the_check_colours_both_shapes_and_names_the_worst(edited):
    editor, tips = edited, star()[2].tolist()
    editor.check()
    assert "four" in editor.message.content
    for tip in tips:
        for side in (0, 1):
            click(editor, side, tip)
    drawn = []
    editor.paint = drawn.append
    editor.check()
    assert "mean energy" in editor.message.content
    (colours,) = drawn
    # the shapes have the same triangles: corresponding vertices get nearly the same colours
    assert np.abs(colours[0] - colours[1]).mean() < 15


def test_the_preview_tells_a_landmark_that_does_not_fit():
    (v, f, tips), (w, g, _) = star(), star(1.1)
    right = previewed((v, f), (w, g), (tips, tips))
    assert right.energy < 5 and right.off.max() < 0.15
    assert right.off[right.cones].max() == 0
    wrong = previewed((v, f), (w, g), (tips, tips[[1, 0, 2, 3, 4]]))
    assert wrong.energy > right.energy + 0.5
    with pytest.raises(NsmError) as refused:
        previewed((v, f), (w, g), (tips[:3], tips[:3]))
    assert (refused.value.kind, refused.value.key) == ("too_few_landmarks", "landmarks")


def test_a_place_that_cannot_be_written_is_said(edited):
    edited.file = edited.file / "below" / "nothing.json"
    edited.save()
    assert "not saved" in edited.message.content


@pytest.fixture
def meshes(tmp_path):
    vertices, faces = sphere()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "a.obj")
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "b.obj")


def test_the_command_begins_with_a_file_and_ends_without_an_error(
    here, tmp_path, meshes, monkeypatch
):
    pytest.importorskip("viser", reason="needs nsm[view]")
    made = []

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("nsm.commands.landmarks.time.sleep", interrupt)
    import nsm.results.view as view

    kept = view.LandmarkEditor
    monkeypatch.setattr(view, "LandmarkEditor", lambda *a: made.append(kept(*a)) or made[-1])
    (tmp_path / "given.json").write_text(
        json.dumps({"names": ["x", "y"], "source": [3, 5], "target": [6, 8]})
    )
    run = here("landmarks", "a.obj", "b.obj", "--landmarks", "given.json", "--port", "0")
    assert run.returncode == 130 and run.stdout.startswith("pairs.json: http://127.0.0.1:")
    assert vertices(made[0]) == [(3, 6), (5, 8)]
    (tmp_path / "a.vts").write_text("3 x\n5 y\n7 z\n")
    (tmp_path / "b.vts").write_text("8 y\n6 x\n")  # z is still to be placed
    words = ["landmarks", "a.obj", "b.obj", "--empty", "--port", "0"]
    run = here(*words, "--landmarks", "a.vts", "b.vts")
    assert run.returncode == 130 and vertices(made.pop()) == [(3, 6), (5, 8), (7, None)]
    (tmp_path / "pairs.csv").write_text("name,a,b\nx,3,6\ny,5,8\n")
    run = here(*words, "--landmarks", "pairs.csv")
    assert run.returncode == 130
    assert [mark.name for mark in made.pop().landmarks.landmarks] == ["x", "y"]
    run = here("landmarks", "a.obj", "b.obj", "b.obj", "--empty", "--port", "0")
    assert run.returncode == 130 and vertices(made[1]) == []
    found = CollectionProposal([np.array([[3, 6], [5, 8]])], [2.0], 0.1, 0, False)
    monkeypatch.setattr("nsm.correspondence.proposed_for_all", lambda _: found)
    run = here("landmarks", "a.obj", "b.obj", "--port", "0")
    assert run.stdout.startswith("2 landmarks proposed, NOT SURE") and vertices(made[2]) == [
        (3, 6),
        (5, 8),
    ]


@pytest.mark.parametrize(
    "words",
    [
        ["a.obj"],
        ["a.obj", "none.obj"],
        ["a.obj", "b.obj", "--out", "there.json"],
        ["a.obj", "b.obj", "--landmarks", "none.json"],
        ["a.obj", "b.obj", "b.obj", "--landmarks", "there.json"],
        ["a.obj", "b.obj", "--landmarks", "there.json", "--out", "new.json", "--port", "http"],
        ["a.obj", "b.obj", "--landmarks", "names.json"],
        ["a.obj", "b.obj", "--landmarks", "large.json"],
        ["soup.obj", "b.obj", "--landmarks", "merged.json"],
        ["a.obj", "b.obj", "--parts", "big"],
        ["a.obj", "b.obj", "--parts", "9"],
    ],
)
def test_wrong_words_are_one_line_and_status_2(here, tmp_path, meshes, words):
    pytest.importorskip("viser", reason="needs nsm[view]")
    (tmp_path / "there.json").write_text('{"source": [1], "target": [2]}')
    (tmp_path / "names.json").write_text('{"source": [1], "target": [2], "names": ["a", "b"]}')
    (tmp_path / "large.json").write_text('{"source": [1], "target": [99999]}')
    points, faces = sphere()
    soup = np.arange(faces.size).reshape(-1, 3)  # triangles that share no vertices
    twice = np.flatnonzero(faces.ravel() == faces[0, 0])[1]
    trimesh.Trimesh(points[faces].reshape(-1, 3), soup, process=False).export(tmp_path / "soup.obj")
    pairs = {"source": [0, int(twice)], "target": [3, 4]}
    (tmp_path / "merged.json").write_text(json.dumps(pairs))
    run = here("landmarks", *words)
    assert run.returncode == 2 and run.stderr.count("\n") == 1, run.stderr


def test_the_command_edits_the_part_that_is_chosen(here, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="needs nsm[view]")
    import nsm.results.view as view

    ball = trimesh.creation.icosphere(subdivisions=1)
    small = ball.copy()
    small.apply_scale(0.6)
    small.apply_translation([3, 0, 0])
    trimesh.util.concatenate([small, ball]).export(tmp_path / "both.obj")
    made = []

    def stop(shapes, *_):
        made.extend(shapes)
        raise KeyboardInterrupt

    monkeypatch.setattr(view, "LandmarkEditor", stop)
    words = ["landmarks", "both.obj", "both.obj", "--empty", "--port", "0"]
    assert here(*words).returncode == 2  # a decision is needed
    for part, first in (("largest", len(small.vertices)), ("1", 0)):
        made.clear()
        assert here(*words, "--parts", part).returncode == 130
        assert [shape.numbers.min() for shape in made] == [first] * 2
