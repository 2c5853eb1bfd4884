"""Caps that close the boundaries of a part: closed manifolds of a wanted area."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from thorough import examples

from nsm.surfaces import topology
from nsm.surfaces.caps import capped
from nsm.surfaces.shapes import hemisphere
from nsm.surfaces.validation import Repairs, clean


def ball(subdivisions=2):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


def cut_ball(direction, height):
    """What lies below a plane: (V, 3) and (F, 3)."""
    vertices, faces = ball()
    kept = faces[vertices[faces].mean(axis=1) @ direction < height]
    mesh = clean(vertices, kept, repairs=Repairs("largest"))
    return mesh.vertices, mesh.faces


def area(vertices, faces):
    return topology.face_areas(vertices, faces).sum()


@examples(20)
@given(
    st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda x: np.linalg.norm(x) > 0.1),
    st.floats(-0.6, 0.9),
    st.floats(1.0, 8.0),
)
def test_capped_parts_are_closed_and_have_the_wanted_area(direction, height, times):
    """Whatever the cut and the area; the new triangles face outward, as those of the part do."""
    direction = np.array(direction) / np.linalg.norm(direction)
    vertices, faces = cut_ball(direction, height)
    wanted = times * area(*ball())
    points, closed, log = capped(vertices, faces, wanted)
    assert topology.genus_and_boundary(closed) == (0, 0) and len(log) == 1
    assert np.array_equal(points[: len(vertices)], vertices)
    assert np.array_equal(closed[: len(faces)], faces)
    assert area(points, closed) == pytest.approx(wanted, rel=0.02)
    solid = trimesh.Trimesh(points, closed, process=False)
    assert solid.is_winding_consistent and solid.volume > 0
    # every new triangle has a vertex that is not the part's
    assert (closed[len(faces) :] >= len(vertices)).any(axis=1).all()


def test_a_flat_cap_is_the_least():
    """Half a ball that is to have no more area than it has is closed by a disc."""
    vertices, faces = hemisphere(9)
    points, closed, _ = capped(vertices, faces, 0.5 * area(vertices, faces))
    disc = points[len(vertices) :]
    assert np.abs(disc[:, 2] - disc[0, 2]).max() < 1e-9
    assert area(points, closed) - area(vertices, faces) == pytest.approx(np.pi, rel=0.01)


def test_several_loops_share_the_area_by_the_squares_of_their_lengths():
    """A funnel, open at both ends, of radii 1 and 2."""
    turn = 2 * np.pi * np.arange(64) / 64
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(64)], axis=1)
    vertices = np.concatenate([ring, 2 * ring + [0, 0, 1]])
    here = np.arange(64)
    after = np.roll(here, -1)
    faces = np.concatenate(
        [np.stack([here, after, here + 64], 1), np.stack([after, after + 64, here + 64], 1)]
    )
    points, closed, log = capped(vertices, faces, area(vertices, faces) + 50.0)
    assert topology.genus_and_boundary(closed) == (0, 0)
    assert "2 boundaries of 64, 64 edges" in log[0]
    corners = points[closed[len(faces) :]]
    top = corners[:, :, 2].max(axis=1) > 0.5
    areas = topology.face_areas(points, closed[len(faces) :])
    assert areas[top].sum() == pytest.approx(40.0, rel=0.02)
    assert areas[~top].sum() == pytest.approx(10.0, rel=0.02)


def test_a_closed_mesh_has_no_caps():
    vertices, faces = ball()
    points, closed, log = capped(vertices, faces, 100.0)
    assert points is vertices and closed is faces and log == []
    mesh = clean(vertices, faces, repairs=Repairs(closed_area=100.0))
    assert mesh.caps is None


def test_small_holes_are_filled_and_not_capped():
    """Fans count as the shape itself; caps are what is left open."""
    vertices, faces = cut_ball(np.array([0.0, 0.0, 1.0]), 0.5)
    low = int(vertices[:, 2].argmin())
    pierced = faces[(faces != low).all(axis=1)]
    mesh = clean(vertices, pierced, repairs=Repairs(fill_holes=8, closed_area=area(*ball())))
    assert topology.genus_and_boundary(mesh.faces) == (0, 0)
    assert mesh.caps is not None and mesh.caps.sum() == mesh.cap_faces
    made = mesh.source_vertex < 0
    assert np.array_equal(mesh.source_vertex[made], -2 - np.arange(made.sum()))
    # the fan's middle is in no cap
    assert not (mesh.source_vertex[mesh.faces[mesh.caps]] == -2).any()
