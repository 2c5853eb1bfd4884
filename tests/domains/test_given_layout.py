"""surface.parameterization=given: the layout starts from texture coordinates, which are checked."""

import numpy as np
import pytest

from nsm.domains import Surface
from nsm.domains.planar_mesh import boundary_self_intersections, flipped_triangles
from nsm.errors import NsmError
from nsm.surfaces.shapes import hemisphere, ring_mesh, saddle
from nsm.surfaces.topology import boundary_loops, is_disc


def load(vertices, faces, uv, **options):
    return Surface.from_arrays(vertices, faces, uv=uv[faces], parameterization="given", **options)


def bent(rings=6):
    """A disc bent in space, and where its vertices are in the plane."""
    uv, faces = ring_mesh(rings)
    return np.column_stack([uv, 0.3 * uv[:, 0] ** 2]), faces, uv


@pytest.mark.parametrize("mirrored", [False, True])
def test_coordinates_that_fill_the_disc_are_kept(mirrored):
    vertices, faces, uv = bent()
    given = (0.3 * uv + 0.5) * ([-1, 1] if mirrored else [1, 1])
    surface = load(vertices, faces, given)
    ids = surface.source_vertex
    known = ids >= 0
    assert np.allclose(surface.uv[known], uv[ids[known]], atol=1e-9)
    assert surface.quality["flipped_triangles"] == 0
    assert any("kept as they are" in line for line in surface.log)


def test_coordinates_that_fill_the_square_are_kept():
    vertices, faces = saddle()
    uv = vertices[:, :2] * [0.25, 0.5] + 0.5
    surface = load(vertices, faces, uv, domain="square")
    known = surface.source_vertex >= 0
    assert np.allclose(surface.uv[known], vertices[surface.source_vertex[known], :2], atol=1e-9)


def test_other_coordinates_are_taken_to_the_domain():
    """The layout follows the plane, not the surface: two surfaces with equal coordinates agree."""
    vertices, faces, uv = bent()
    given = uv * [2.0, 1.0]
    one = load(vertices, faces, given)
    other = load(vertices * [1, 3, 1], faces, given)
    assert one.quality["flipped_triangles"] == 0
    assert np.allclose(one.uv, other.uv, atol=1e-9)
    # and it is not turned: the long axis stays
    known = one.source_vertex >= 0
    x = one.uv[known]
    assert (x * given[one.source_vertex[known]]).sum() > 0.9 * np.linalg.norm(x) * np.linalg.norm(
        given[one.source_vertex[known]]
    )


def test_seams_are_those_of_the_coordinates():
    """A hemisphere's two halves, laid out with a gap between that closes at the pole's edge."""
    vertices, faces = hemisphere()
    uv = vertices[faces][:, :, :2]
    apart = vertices[faces].mean(axis=1)[:, 0] > 0
    with pytest.raises(NsmError) as refused:
        Surface.from_arrays(
            vertices,
            faces,
            uv=np.where(apart[:, None, None], uv + [5, 0], uv),
            parameterization="given",
        )
    assert (refused.value.kind, refused.value.key) == ("unusable_uv", "surface.parameterization")
    assert "2 islands" in str(refused.value)


def folded(uv):
    uv = uv.copy()
    uv[0] = [3.0, 0.0]  # the middle, moved out
    return uv


def curled(uv):
    """Angles doubled: no triangle flips, but the border goes around twice."""
    z = (uv[:, 0] + 1.5 + 1j * uv[:, 1]) ** 6
    return np.stack([z.real, z.imag], axis=1)


@pytest.mark.parametrize("change", [folded, curled])
def test_unusable_coordinates_are_refused(change):
    vertices, faces, uv = bent()
    with pytest.raises(NsmError) as refused:
        load(vertices, faces, change(uv))
    assert refused.value.kind == "unusable_uv" and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ({"uv": None}, "missing_uv"),
        ({"domain": "orbifold"}, "wrong_domain"),
        ({"seam_vertices": [1, 2]}, "conflicting_settings"),
    ],
)
def test_what_does_not_go_with_them_is_refused(options, kind):
    vertices, faces, uv = bent()
    with pytest.raises(NsmError) as refused:
        Surface.from_arrays(
            vertices, faces, **{"uv": uv[faces], "parameterization": "given", **options}
        )
    assert refused.value.kind == kind


def test_a_mirrored_island_is_turned_over_and_that_is_said():
    vertices, faces, uv = bent()
    for sign, said in ((1, False), (-1, True)):
        surface = load(vertices, faces, uv * [sign, 1])
        assert any("mirrored" in line for line in surface.log) == said


def with_holes():
    """The bent disc with two holes."""
    vertices, faces, uv = bent(10)
    middle = uv[faces].mean(axis=1)
    hole = np.zeros(len(faces), dtype=bool)
    for place in ([0.5, 0], [-0.4, -0.3]):
        hole |= np.linalg.norm(middle - place, axis=1) < 0.2
    return vertices, faces[~hole], uv


@pytest.mark.parametrize("sign", [1, -1])
def test_an_island_with_holes_is_cut_open(sign):
    vertices, faces, uv = with_holes()
    assert len(boundary_loops(faces)) == 3
    surface = load(vertices, faces, uv * [sign, 1])
    assert any("2 holes" in line for line in surface.log)
    assert is_disc(surface.faces) and len(surface.seam_pairs) > 2
    known = surface.source_vertex >= 0
    own, given = surface.given_uv[known], uv[surface.source_vertex[known]]
    given = given - given.mean(axis=0)
    given *= np.linalg.norm(own - own.mean(axis=0)) / np.linalg.norm(given)
    assert np.abs(own - own.mean(axis=0) - given).max() < 2e-3  # but for a hair at the cuts
    assert flipped_triangles(surface.given_uv, surface.faces) == 0
    loop = boundary_loops(surface.faces)[0]
    assert boundary_self_intersections(surface.given_uv, loop) == 0


def test_an_island_that_covers_a_hole_twice_is_refused():
    vertices, faces, uv = with_holes()
    z = (uv[:, 0] - 0.5 + 1j * uv[:, 1]) ** 2  # around one of the holes
    with pytest.raises(NsmError) as refused:
        load(vertices, faces, np.stack([z.real, z.imag], axis=1))
    assert refused.value.kind == "unusable_uv"
