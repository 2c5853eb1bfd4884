"""Meshes as users have them."""

import numpy as np
import pytest
import torch
import trimesh

from nsm.errors import NsmError
from nsm.surfaces.given import given_mesh

BOX = trimesh.creation.box()
SEAMED = """v 0 0 0
v 1 0 0
v 0 1 0
v 1 1 0
v 9 9 9
vt 0 0
vt 1 1
f 1/1 2/1 3/1
f 2/2 4/2 3/2
"""


@pytest.mark.parametrize(
    "given",
    [
        BOX,
        (BOX.vertices, BOX.faces),
        [BOX.vertices.tolist(), BOX.faces.tolist()],
        (torch.tensor(np.array(BOX.vertices)), torch.tensor(np.array(BOX.faces))),
    ],
)
def test_objects_and_arrays_are_the_same_mesh(given):
    mesh = given_mesh(given, "box")
    assert mesh.name == "box"
    assert np.array_equal(mesh.vertices, BOX.vertices)
    assert np.array_equal(mesh.faces, BOX.faces)


@pytest.mark.parametrize("given", [3, None, (BOX.vertices,), {"vertices": 1}, object()])
def test_what_is_no_mesh_is_refused(given):
    with pytest.raises(NsmError) as caught:
        given_mesh(given, "source")
    assert (caught.value.kind, caught.value.key) == ("wrong_type", "source")


def test_other_vertex_numbers_than_the_file_has_are_told(tmp_path):
    file = tmp_path / "seamed.obj"
    file.write_text(SEAMED)
    same = trimesh.load(file, process=False, maintain_order=True)
    other = trimesh.load(file)
    assert len(other.vertices) != 5
    mesh = given_mesh(other)
    assert mesh.name == "seamed"
    assert len(mesh.log) == 1
    assert len(mesh.vertices) == len(other.vertices)
    assert bool(given_mesh(same).log) == (len(same.vertices) != 5)
    assert given_mesh(str(file)).log == ()


def test_a_scene_as_trimesh_reads_glb_files_is_its_mesh(tmp_path):
    file = tmp_path / "box.glb"
    trimesh.Scene(BOX).export(file)
    scene = trimesh.load(file)
    mesh = given_mesh(scene)
    own = given_mesh(file)
    assert mesh.name == "box" and mesh.log == ()
    assert np.allclose(mesh.vertices, own.vertices) and np.array_equal(mesh.faces, own.faces)
