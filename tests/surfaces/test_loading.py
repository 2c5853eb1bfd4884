"""Broken and unusual mesh files: read whole, or refused in one line that names the file."""

import numpy as np
import pytest
import trimesh

from nsm.errors import NsmError
from nsm.surfaces import topology
from nsm.surfaces.loading import load_mesh

ENDINGS = ["obj", "off", "ply", "stl", "glb", "gltf"]


def refusal(path) -> str:
    with pytest.raises(NsmError) as caught:
        load_mesh(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


@pytest.mark.parametrize("ending", ["off", "ply", "stl", "glb"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_a_truncated_file_is_refused(tmp_path, ending, share):
    whole = tmp_path / f"whole.{ending}"
    trimesh.creation.icosphere(subdivisions=2).export(whole)
    raw = whole.read_bytes()
    part = tmp_path / f"part.{ending}"
    part.write_bytes(raw[: int(share * len(raw))])
    refusal(part)


@pytest.mark.parametrize("lines", ["v 0 0 0\nv 1 0", "v 0 0 0\nv 1 0 0\n", "f 1 2"])
def test_a_truncated_obj_is_refused(tmp_path, lines):
    # cut between two face lines an OBJ file looks whole: it does not say how much there is of it
    file = tmp_path / "part.obj"
    file.write_text(lines)
    refusal(file)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("content", [b"", b"Dear Sir,\nno mesh here.\n", b"\x00\xff\x10" * 300])
def test_what_is_no_mesh_is_refused(tmp_path, ending, content):
    file = tmp_path / f"letter.{ending}"
    file.write_bytes(content)
    refusal(file)


def test_paths_that_lead_nowhere(tmp_path):
    assert "no such file" in refusal(tmp_path / "none.obj")
    assert "folder" in refusal(tmp_path)
    (tmp_path / "mesh.xyz").write_text("0 0 0")
    assert "unknown mesh format '.xyz'" in refusal(tmp_path / "mesh.xyz")


@pytest.mark.parametrize("face", ["f 1 2 9", "f 0 1 2", "f -1 -2 -9", "f 1 2 x"])
def test_obj_faces_of_missing_vertices(tmp_path, face):
    file = tmp_path / "bad.obj"
    file.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{face}\n")
    refusal(file)


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


def test_parts_of_a_scene_are_moved_and_put_together(tmp_path):
    scene = trimesh.Scene()
    for shift in (0.0, 5.0):
        move = trimesh.transformations.translation_matrix([shift, 0, 0])
        scene.add_geometry(trimesh.creation.box(), transform=move)
    scene.export(tmp_path / "two.glb")
    vertices, faces, log = load_mesh(tmp_path / "two.glb")
    assert len(faces) == 24
    assert np.ptp(vertices[:, 0]) == pytest.approx(6)
    assert log == ("2 parts of the scene were put together",)
