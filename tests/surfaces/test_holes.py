"""Small holes are filled for the map, told, and left out of what is exported."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.domains import Surface
from nsm.errors import NsmError
from nsm.results.meshes import export_surface
from nsm.surfaces import topology
from nsm.surfaces.holes import fill
from nsm.surfaces.shapes import hemisphere
from nsm.surfaces.validation import Repairs, clean


def ball():
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def pierced(*holes):
    """A ball without the faces around some vertices."""
    vertices, faces = ball()
    return vertices, faces[~np.isin(faces, holes).any(axis=1)]


@examples(20)
@given(st.sets(st.integers(0, 161), min_size=1, max_size=6))
def test_filled_balls_are_closed_and_oriented(removed):
    """Whatever the holes are, also ones that touch each other."""
    try:
        mesh = clean(*pierced(*removed), repairs=Repairs("largest", fill_holes=100))
    except NsmError:
        return
    assert topology.genus_and_boundary(mesh.faces) == (0, 0)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_winding_consistent and solid.volume > 0
    made = mesh.source_vertex < 0
    assert len(np.unique(mesh.source_vertex[made])) == made.sum() > 0
    assert (mesh.source_vertex[made] <= -2).all()
    assert any("filled" in line for line in mesh.log)


def test_the_limit_says_which_holes_are_filled():
    vertices, faces = pierced(0, 100)  # of five edges, and of six
    assert sorted(len(loop) for loop in topology.boundary_loops(faces)) == [5, 6]
    for limit, left in ((False, [5, 6]), (4, [5, 6]), (5, [6]), (6, []), (True, [6])):
        _, filled, log = fill(vertices, faces, limit)
        assert [len(loop) for loop in topology.boundary_loops(filled)] == sorted(left, reverse=True)
        assert len(log) == (len(left) < 2)
    # half a ball has a boundary that is no small hole
    assert fill(*hemisphere(), True)[2] == []


@pytest.mark.parametrize("domain", ["disc", "orbifold"])
def test_exported_meshes_keep_their_holes(domain, tmp_path):
    vertices, faces = pierced(0, 100)
    surface = Surface.from_arrays(vertices, faces, domain=domain, repairs=Repairs(fill_holes=8))
    assert surface.topology == (0, 0)
    export_surface(tmp_path / "a.obj", surface.vertices, surface, surface.uv)
    shown = trimesh.load(tmp_path / "a.obj", process=False)
    whole = trimesh.Trimesh(vertices, faces, process=False)
    assert shown.area == pytest.approx(whole.area * surface.scale**2, rel=1e-5)
    assert len(shown.vertices) < len(surface.vertices)
    if domain == "orbifold":
        used, _ = topology.renumbered(faces, len(vertices))
        points = (vertices[used] - surface.center) * surface.scale
        assert np.allclose(shown.vertices, points, atol=1e-6)


def test_a_cut_through_a_filled_hole_leaves_no_piece_of_it():
    """Faces over a hole stay known where the cut splits them."""
    vertices, faces = pierced(0)
    filled, closed, _ = fill(vertices, faces, True)
    centre = len(vertices)
    ends = [int(np.argmax(vertices @ d)) for d in ([0, 0, 1.0], [1.0, 0, 0])]
    mesh = Surface.from_arrays(
        filled, closed, seam_vertices=[*ends, centre], parameterization="tutte"
    )
    source = np.where(mesh.source_vertex == centre, -2, mesh.source_vertex)
    surface = replace(mesh, source_vertex=source)
    open_, cut = trimesh.Trimesh(vertices, faces), surface.vertices[surface.faces[~surface.filled]]
    area = trimesh.triangles.area(cut).sum()
    assert area == pytest.approx(open_.area * mesh.scale**2, rel=1e-9)
