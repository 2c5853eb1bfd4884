"""Certificates of maps, and the repair of maps that flip triangles."""

import numpy as np
import pytest
import torch

import nsm
from nsm.domains import Disc
from nsm.errors import NsmError
from nsm.maps import DiscMap, NeuralMap, Rotated
from nsm.maps.activations import Sine
from nsm.results import SurfaceMap
from nsm.results.analytic import analytic_surface
from nsm.results.certificate import Correction, certificate, combined, repaired, verdict
from nsm.surfaces.shapes import ring_mesh

UV, FACES = ring_mesh(8)


def test_the_identity_is_certified():
    found = certificate(Disc(), UV, FACES)
    assert found == {"certified": True, "flipped_triangles": 0, "boundary_order_violations": 0}
    assert verdict(found).startswith("certified injective")


def test_flips_and_flat_triangles_are_counted_each():
    image = UV.copy()
    inner = int(np.linalg.norm(UV, axis=1).argmin())
    image[inner] += [0.2, 0.0]  # over the next ring
    a, b, c = (np.c_[image, np.zeros(len(UV))][FACES[:, k]] for k in range(3))
    turned = int((np.cross(b - a, c - a)[:, 2] <= 0).sum())
    found = certificate(Disc(), image, FACES)
    assert turned > 0 and found["flipped_triangles"] == turned and not found["certified"]
    image[FACES[0]] = image[FACES[0][0]]  # a triangle shrunk to a point
    assert certificate(Disc(), image, FACES)["flipped_triangles"] > turned
    assert "NOT certified" in verdict(found)


def test_a_map_that_overlaps_itself_without_flips_is_not_certified():
    """A long strip wound around twice: each triangle is well, the whole is not injective."""
    n = 60
    t = np.linspace(0, 1, n)
    strip = np.concatenate([np.c_[t, np.zeros(n)], np.c_[t, np.full(n, 0.1)]])
    k = np.arange(n - 1)
    faces = np.concatenate([np.c_[k, k + 1, n + k], np.c_[k + 1, n + k + 1, n + k]])
    assert certificate(None, strip, faces)["certified"]
    angle, radius = 4 * np.pi * strip[:, 0], 1 - strip[:, 1]
    wound = np.c_[radius * np.cos(angle), radius * np.sin(angle)]
    found = certificate(None, wound, faces)
    assert found["flipped_triangles"] == 0 and found["boundary_self_intersections"] > 0
    assert not found["certified"]
    assert not certificate(Disc(), wound, faces)["certified"]


def test_together_all_must_hold_and_counts_add_up():
    good = {"certified": True, "flipped_triangles": 0, "boundary_order_violations": 0}
    bad = {"certified": False, "flipped_triangles": 2, "boundary_order_violations": 1}
    assert combined([good, good]) == good
    assert combined([good, bad, bad]) == {
        "certified": False,
        "flipped_triangles": 4,
        "boundary_order_violations": 2,
    }


@pytest.fixture(scope="module")
def folded():
    """A map of the disc to itself that folds, with three landmarks; and meshes of few triangles."""
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setattr(Disc, "mesh", lambda self: ring_mesh(12))
    plane = analytic_surface({"name": "plane"}, "disc")
    bowl = analytic_surface({"name": "paraboloid"}, "disc")
    monkeypatch.undo()
    torch.manual_seed(3)
    network = NeuralMap(DiscMap.network_out_dim, width=16, depth=1, activation=Sine(6.0))
    h = Rotated(DiscMap(network), torch.eye(2))
    for p in h.inner.network.output.parameters():
        torch.nn.init.normal_(p, std=0.045)
    h = h.eval().requires_grad_(False)
    return SurfaceMap(plane, bowl, h, np.array([[0, 0], [100, 90], [200, 210]]))


@pytest.fixture(scope="module")
def better(folded):
    return folded.repaired()


def test_a_folding_map_is_mended_and_certified(folded, better):
    assert folded.certificate["flipped_triangles"] > 0
    assert better.certificate["certified"]
    moved = better.correction.vertices
    assert 0 < len(moved) < len(folded.image_uv)
    others = np.setdiff1d(np.arange(len(folded.image_uv)), moved)
    assert (better.image_uv[others] == folded.image_uv[others]).all()
    assert np.linalg.norm(better.image_uv, axis=1).max() <= 1 + 1e-6


def test_points_and_transfer_use_what_is_certified(folded, better):
    s, t = better.source, better.target
    corner = better.correction.vertices
    points = s.in_original_units(s.surface.vertices[corner])
    lifted = better.image[corner]
    assert np.abs(better(points) - t.in_original_units(lifted)).max() < 1e-9
    # inside of a triangle: the affine image of the triangle
    face = s.surface.faces[17]
    middle = s.in_original_units(s.surface.vertices[face].mean(axis=0, keepdims=True))
    uv = better.planar(s.surface.uv[face].mean(axis=0, keepdims=True))
    assert np.abs(uv - better.image_uv[face].mean(axis=0)).max() < 1e-9
    assert np.linalg.norm(better(middle) - folded(middle)) < 0.5
    # there and back over a map that is injective: values that are linear come back
    height = s.surface.vertices[:, 0]
    again = better.transfer(better.transfer(height), back=True)
    assert np.abs(again - height).mean() < 0.02


def test_a_mended_map_is_given_back_as_it_was(better, tmp_path):
    better.save(tmp_path)
    again = nsm.load(tmp_path)
    assert (again.image_uv == better.image_uv).all()
    assert again.certificate == better.certificate


def test_landmarks_stay_where_they_are_if_that_can_be(folded, better):
    held = better.landmarks[:, 0]
    assert (better.image_uv[held] == folded.image_uv[held]).all()


def test_corrections_that_fit_no_map_are_refused(folded, tmp_path):
    for wrong in (
        Correction(np.array([10**6]), np.zeros((1, 2))),
        Correction(np.array([0]), np.full((1, 2), np.nan)),
        Correction(np.array([0, 1]), np.zeros((1, 2))),
    ):
        with pytest.raises(ValueError, match="correct"):
            Correction.taken(wrong.tensors(), len(folded.image_uv))
    from dataclasses import replace

    broken = replace(folded, correction=Correction(np.array([10**6]), np.zeros((1, 2))))
    broken.save(tmp_path)
    with pytest.raises(NsmError):
        nsm.load(tmp_path)


def test_a_boundary_out_of_order_is_put_in_order(folded):
    surface = folded.source.surface
    image = surface.uv.copy()
    rim = np.flatnonzero(np.linalg.norm(image, axis=1) > 1 - 1e-9)
    order = rim[np.argsort(np.arctan2(*image[rim].T[::-1]))]
    image[order[[5, 6]]] = image[order[[6, 5]]]
    assert certificate(Disc(), image, surface.faces)["boundary_order_violations"] > 0
    better = repaired(Disc(), surface.uv, surface.faces, image, np.zeros(len(image), bool))
    assert certificate(Disc(), better, surface.faces)["certified"]
