"""Damaged and unusual mesh files: read completely, or refused with the file as the key."""

import numpy as np
import pytest
import trimesh

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.loading import is_mesh_path, load_mesh

ENDINGS = ["obj", "off", "ply", "stl", "glb", "gltf"]


def refusal(path) -> str:
    """The kind of error that a file is refused with."""
    with pytest.raises(NsmError) as caught:
        load_mesh(path)
    assert caught.value.key == str(path)
    assert "\n" not in str(caught.value)
    return caught.value.kind


@pytest.mark.parametrize("ending", ["off", "ply", "stl", "glb"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_a_truncated_file_is_refused(tmp_path, ending, share):
    whole = tmp_path / f"whole.{ending}"
    trimesh.creation.icosphere(subdivisions=2).export(whole)
    raw = whole.read_bytes()
    part = tmp_path / f"part.{ending}"
    part.write_bytes(raw[: int(share * len(raw))])
    assert refusal(part) in ("unreadable_file", "not_a_mesh")


@pytest.mark.parametrize(
    ("lines", "kind"),
    [
        ("v 0 0 0\nv 1 0", "unreadable_file"),
        ("v 0 0 0\nv 1 0 0\n", "not_a_mesh"),
        ("f 1 2", "unreadable_file"),
    ],
)
def test_a_truncated_obj_is_refused(tmp_path, lines, kind):
    # an OBJ file cut between two face lines looks complete: it has no counts
    file = tmp_path / "part.obj"
    file.write_text(lines)
    assert refusal(file) == kind


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("content", [b"", b"Dear Sir,\nno mesh here.\n", b"\x00\xff\x10" * 300])
def test_files_without_a_mesh_are_refused(tmp_path, ending, content):
    file = tmp_path / f"letter.{ending}"
    file.write_bytes(content)
    assert refusal(file) in ("unreadable_file", "not_a_mesh")


def test_wrong_paths(tmp_path):
    assert refusal(tmp_path / "none.obj") == "missing_file"
    assert refusal(tmp_path / f"{'m' * 300}.obj") == "unreadable_file"
    assert refusal(tmp_path) == "not_a_file"
    (tmp_path / "mesh.xyz").write_text("0 0 0")
    assert refusal(tmp_path / "mesh.xyz") == "unknown_format"


@pytest.mark.parametrize(
    ("face", "kind"),
    [
        ("f 1 2 9", "out_of_range"),
        ("f 0 1 2", "unreadable_file"),
        ("f -1 -2 -9", "out_of_range"),
        ("f 1 2 x", "unreadable_file"),
    ],
)
def test_obj_faces_of_missing_vertices(tmp_path, face, kind):
    file = tmp_path / "bad.obj"
    file.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{face}\n")
    assert refusal(file) == kind


def test_mesh_paths_on_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("scan", "a=b.obj"):
        (tmp_path / name).touch()
        assert is_mesh_path(name) and is_mesh_path(str(tmp_path / name))
    (tmp_path / "folder").mkdir()
    for name in ("mesh.obj", "no/such/MESH.PLY", "../x.off", "a.b.glb"):
        assert is_mesh_path(name)
    for name in ("cow", "folder", "", "mesh.txt", "obj", "seed=1", "surface.path=mesh.obj"):
        assert not is_mesh_path(name)
    assert not is_mesh_path("a\0b") and not is_mesh_path("m" * 5000)


def test_obj_with_tabs_indents_and_continued_lines(tmp_path):
    file = tmp_path / "odd.obj"
    file.write_bytes(
        b"v\t0 0 0\r\n  v 1 0 0\r\nv 1 1 0\r\nv 0 1 0\r\nf\t1 2 \\\r\n3\r\nf 1 3 4\r\n"
    )
    vertices, faces, _ = load_mesh(file)
    assert len(vertices) == 4
    assert np.array_equal(faces, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("header", ["OFF\n4 1 0", "OFF 4 1 0", "# by hand\nOFF\n# counts\n4 1 0"])
def test_off_headers(tmp_path, header):
    file = tmp_path / "quad.off"
    file.write_text(f"{header}\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 255 0 0\n")
    vertices, faces, log = load_mesh(file)
    assert topology.face_areas(vertices, faces).sum() == pytest.approx(1)
    assert "triangulated" in log[0]


def test_two_quads_that_share_two_sides(tmp_path):
    """The same diagonal in both would be an edge of four triangles."""
    file = tmp_path / "pillow.off"
    file.write_text(
        "OFF\n6 5 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 0.5 1\n0 0 1\n"
        "4 0 1 2 3\n4 0 3 2 4\n3 2 1 4\n3 1 0 4\n3 0 0 5\n"
    )
    _, faces, _ = load_mesh(file)
    distinct = faces[(faces[:, 0] != faces[:, 1])]
    assert topology.edges_of(distinct).count.max() == 2


def test_meshes_of_a_scene_are_moved_and_combined(tmp_path):
    scene = trimesh.Scene()
    for shift in (0.0, 5.0):
        move = trimesh.transformations.translation_matrix([shift, 0, 0])
        scene.add_geometry(trimesh.creation.box(), transform=move)
    scene.export(tmp_path / "two.glb")
    vertices, faces, log = load_mesh(tmp_path / "two.glb")
    assert len(faces) == 24
    assert np.ptp(vertices[:, 0]) == pytest.approx(6)
    assert len(log) == 1
