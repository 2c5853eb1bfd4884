"""Landmarks: files of all formats, faults in them, and the vertices that stand for them."""

import hashlib
import http.server
import io
import json
import threading
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from thorough import examples

from nsm.cli import _place
from nsm.domains.joint_preparation import Mesh
from nsm.errors import NsmError
from nsm.pipeline.landmark_inputs import landmark_vertices
from nsm.pipeline.resolve_inputs import read_shape
from nsm.surfaces import catalogue
from nsm.surfaces.landmark_files import (
    read_collection,
    read_landmarks,
    read_marks,
    read_names,
    read_pairs,
    to_json,
)
from nsm.surfaces.landmarks import as_vertices
from nsm.surfaces.shapes import sphere

PP = """<!DOCTYPE PickedPoints>
<PickedPoints>
 <DocumentData><DataFileName name="a.ply"/></DocumentData>
 <point x="0" y="0.5" z="1" name="nose" active="1"/>
 <point active="0" name="not this" x="9" y="9" z="9"/>
 <point name="tail &amp; tip" active="1" z="-1" y="2e-1" x="0"/>
</PickedPoints>
"""


@pytest.mark.parametrize(
    ("name", "text", "landmarks", "names"),
    [
        ("a.vts", " 24226 0.0 0.0 0.0\n\n 7 1 2 3\n", [24226, 7], None),
        ("a.txt", "# feet\r\n5\r\n12  # left\r\n", [5, 12], None),
        ("a.txt", "5 left ear\n12 right ear\n", [5, 12], ("left ear", "right ear")),
        ("a.txt", "5 ear\n12 ear\n", [5, 12], None),  # a name must tell one from the others
        ("a.pinned", "lk 4816\nlk 4152\n", [4816, 4152], None),
        ("a.bary", "3 0.2 0.3 0.5 nose\n0 1 0 0 tail\n", [[3, 0.2, 0.3, 0.5], [0, 1, 0, 0]], 2),
        ("a.pp", PP, [[0, 0.5, 1], [0, 0.2, -1]], ("nose", "tail & tip")),
        ("a.json", "[3, 4]", [3, 4], None),
        ("a.json", "[[3, 0.5, 0.5, 0]]", [[3, 0.5, 0.5, 0]], None),
        ("a.json", '{"nose": [0, 1, 2], "tail": [3, 4, 5]}', [[0, 1, 2], [3, 4, 5]], 2),
    ],
)
def test_each_format(tmp_path, name, text, landmarks, names):
    (tmp_path / name).write_text(text)
    marks = read_marks(tmp_path / name)
    assert np.array_equal(marks.landmarks, landmarks)
    assert marks.names == (("nose", "tail") if names == 2 else names)


@pytest.mark.parametrize(
    ("name", "text", "kind", "line"),
    [
        ("a.vts", "1\nx\n", "damaged_file", "line 2"),
        ("a.pinned", "lk 1\nlk\n", "damaged_file", "line 2"),
        ("a.pinned", "lk one\n", "damaged_file", "line 1"),
        ("a.bary", "1 1 0 0\n\n2 1 0\n", "damaged_file", "line 3"),
        ("a.bary", "1.5 1 0 0\n", "damaged_file", "line 1"),
        ("a.bary", "1 nan 0 0\n", "damaged_file", "line 1"),
        ("a.pp", PP.replace('x="0" y', 'x="a" y'), "damaged_file", "line 4"),
        ("a.pp", PP[:150], "damaged_file", "line"),
        ("a.pp", '<!DOCTYPE p [<!ENTITY a "b">]><p>&a;</p>', "damaged_file", "line 1"),
        ("a.pp", "<PickedPoints/>", "no_landmarks", ""),
        ("a.txt", "# none\n", "no_landmarks", ""),
        ("a.json", "[]", "no_landmarks", ""),
        ("a.json", '{"nose": 1, "tail": [0, 0, 0]}', "wrong_type", ""),
        ("a.json", "[[1, 0.5, 0.5, 0], [0, 0, 0]]", "wrong_type", ""),
        ("a.json", "[[1e999, 0, 0]]", "wrong_type", ""),
        ("a.csv", "1\n", "unknown_format", ""),
    ],
)
def test_each_fault_names_file_and_line(tmp_path, name, text, kind, line):
    (tmp_path / name).write_text(text)
    with pytest.raises(NsmError) as refused:
        read_landmarks(tmp_path / name)
    assert refused.value.kind == kind and refused.value.key.startswith(str(tmp_path / name))
    assert line in str(refused.value) and "\n" not in str(refused.value)
    # of the frames below this test, none is told as the user's own
    found = refused.value.with_traceback(refused.value.__traceback__.tb_next)
    assert _place(found) == ""


@examples(30)
@given(
    st.integers(2, 4),
    st.integers(1, 5),
    st.booleans(),
    st.randoms(use_true_random=False),
)
def test_what_is_written_is_read(tmp_path_factory, surfaces, count, in_triangles, random):
    file = tmp_path_factory.mktemp("pairs") / "pairs.json"
    shape = (count, 4) if in_triangles else (count,)
    entries = [[random.randrange(99) for _ in range(int(np.prod(shape)))] for _ in range(surfaces)]
    lists = [np.reshape(entry, shape) for entry in entries]
    names = [f"point {k}" for k in range(count)]
    file.write_text(to_json(lists, names, confidence=0.5))
    read = read_pairs(file) if surfaces == 2 else read_collection(file)
    assert all(np.array_equal(a, b) for a, b in zip(read, lists, strict=True))
    assert read_names(file) == names and json.loads(file.read_text())["confidence"] == 0.5


def test_a_collection_of_two_is_a_pair(tmp_path):
    (tmp_path / "a.json").write_text('{"landmarks": [[1, 2], [3, 4]]}')
    assert read_pairs(tmp_path / "a.json") == ([1, 2], [3, 4])
    (tmp_path / "a.json").write_text('{"landmarks": [[1, 2], [3, 4], [5, 6]], "names": [1]}')
    for read in (read_pairs, read_names):
        with pytest.raises(NsmError) as refused:
            read(tmp_path / "a.json")
        assert refused.value.kind == "wrong_type"


@examples(30)
@given(st.lists(st.integers(0, 5119), min_size=1, max_size=8, unique=True), st.data())
def test_places_move_to_the_nearest_corner(triangles, data):
    vertices, faces = sphere()
    weights = [
        np.array(data.draw(st.tuples(*[st.integers(1, 9)] * 3)), dtype=float) for _ in triangles
    ]
    places = [[f, *(w / w.sum())] for f, w in zip(triangles, weights, strict=True)]
    points = np.stack([place[1:] @ vertices[faces[int(place[0])]] for place in places])
    far = [
        np.linalg.norm(p - vertices[faces[f]], axis=1)
        for p, f in zip(points, triangles, strict=True)
    ]
    ids = [faces[f][d.argmin()] for f, d in zip(triangles, far, strict=True)]
    if len(set(ids)) < len(ids):
        with pytest.raises(NsmError) as refused:
            as_vertices(places, vertices, faces, "a")
        assert refused.value.kind == "duplicate_landmark"
        return
    found = as_vertices(places, vertices, faces, "a")
    assert np.allclose(found.moved, [d.min() for d in far])
    assert np.allclose(np.linalg.norm(vertices[found.vertex] - points, axis=1), found.moved)


@pytest.mark.parametrize(
    ("place", "kind"),
    [
        ([5120, 1, 0, 0], "out_of_range"),
        ([-1, 1, 0, 0], "out_of_range"),
        ([0.5, 1, 0, 0], "out_of_range"),
        ([0, 0.5, 0.4, 0], "not_on_surface"),
        ([0, 1.5, -0.5, 0], "not_on_surface"),
    ],
)
def test_places_off_the_mesh_are_refused(place, kind):
    with pytest.raises(NsmError) as refused:
        as_vertices([place], *sphere(), "a")
    assert (refused.value.kind, refused.value.key) == (kind, "a")


def test_places_need_the_triangles_of_the_file():
    with pytest.raises(NsmError) as refused:
        as_vertices([[0, 1, 0, 0]], sphere()[0], None, "a")
    assert refused.value.kind == "wrong_type"


@pytest.fixture
def balls():
    return [Mesh(name, *sphere()) for name in ("a", "b", "c")]


def printed(given, shapes):
    console = Console(record=True, file=io.StringIO())
    ids = landmark_vertices(given, shapes, console)
    return [item.tolist() for item in ids], console.export_text()


def test_names_say_what_corresponds(tmp_path, balls):
    (tmp_path / "a.txt").write_text("1 nose\n2 tail\n3 ear\n")
    (tmp_path / "b.json").write_text('{"tail": 20, "nose": 10}')
    vertices = balls[2].vertices
    x, y = (
        " ".join(f'{k}="{v}"' for k, v in zip("xyz", vertices[i], strict=True)) for i in (100, 200)
    )
    (tmp_path / "c.pp").write_text(f'<p><point {x} name="tail"/><point {y} name="nose"/></p>')
    files = [str(tmp_path / name) for name in ("a.txt", "b.json", "c.pp")]
    ids, said = printed(files, balls)
    assert ids == [[1, 2], [10, 20], [200, 100]]
    assert "ear" in said and "moved" not in said
    (tmp_path / "c.pp").write_text(f'<p><point {x} name="hoof"/></p>')
    with pytest.raises(NsmError) as refused:
        landmark_vertices(files, balls)
    assert (refused.value.kind, refused.value.key) == ("different_names", "landmarks")
    # where one file has no names, the order counts: here lengths differ
    (tmp_path / "c.txt").write_text("5\n6\n")
    assert printed([files[1], str(tmp_path / "c.txt")], balls[:2])[0] == [[20, 10], [5, 6]]


def test_it_is_said_how_far_landmarks_move(balls):
    vertices, faces = sphere()
    ids, said = printed({"source": [[7, 0.6, 0.2, 0.2]], "target": [4]}, balls[:2])
    assert ids == [[faces[7, 0]], [4]]
    place = np.array([0.6, 0.2, 0.2]) @ vertices[faces[7]]
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    percent = 100 * np.linalg.norm(place - vertices[faces[7, 0]]) / size
    assert f"{percent:.3f} %" in said and "landmarks of a" in said and "of b" not in said
    assert printed([[1, 2], [5, 6]], balls[:2])[1] == ""


def test_landmarks_come_with_the_catalogue(tmp_path, monkeypatch, balls):
    """A mesh and its landmarks, from a server of our own."""
    text = b"7 0 0 0\n9 0 0 0\n"
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "a.vts").write_bytes(text)
    digest = hashlib.sha256(text).hexdigest()
    remote = catalogue._Remote("a.vts", "http://127.0.0.1:9/a.vts", digest)
    monkeypatch.setitem(catalogue._LANDMARKS, "tiny", remote)
    monkeypatch.setenv("NSM_CACHE", str(tmp_path / "cache"))
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path / "files")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        monkeypatch.setenv("NSM_MESH_URL", f"http://127.0.0.1:{running.server_port}")
        ids, _ = printed(["tiny", "tiny"], balls[:2])
        running.shutdown()
    assert ids == [[7, 9], [7, 9]]
    assert printed(["tiny", "tiny"], balls[:2])[0] == ids  # from the cache


def test_every_animal_of_the_catalogue_has_landmarks():
    animals = [
        n for n in catalogue.catalogue_names() if n.startswith("shrec") or n in ("cat", "horse")
    ]
    assert animals and all(catalogue.has_landmarks(name) for name in animals)
    assert set(catalogue._LANDMARKS) <= set(catalogue._REMOTE)


def test_landmark_files_of_the_classic_models(shared_meshes):
    """Each reads, and lies on its mesh; those of the catalogue are the files that it names."""
    files = sorted((shared_meshes / "landmarks").iterdir())
    assert files
    ours = {remote.file: remote.sha256 for remote in catalogue._LANDMARKS.values()}
    for file in files:
        mesh = next(shared_meshes.glob(f"{file.stem}.*"))
        shape = read_shape(str(mesh), None, "source")
        given = read_landmarks(file)
        assert len(landmark_vertices([given, given], [shape, shape])[0]) >= 3
        if file.name in ours:
            assert hashlib.sha256(file.read_bytes()).hexdigest() == ours[file.name]
