"""Normal variation against closed forms: planes, waves, spheres and creases."""

import numpy as np
import pytest
import torch
from torch import nn

from nsm.domains import Surface
from nsm.domains.surface import as_it_lies
from nsm.results.wrinkles import normal_variation

N = 64  # squares along each side of [-1, 1]²
U, V = np.meshgrid(np.linspace(-1, 1, N + 1), np.linspace(-1, 1, N + 1), indexing="ij")
UV = np.stack([U.ravel(), V.ravel()], axis=1)


class Graph(nn.Module):
    """(u, v) to a point of space, by a function of torch tensors; its Jacobian by autograd."""

    def __init__(self, point):
        super().__init__()
        self.point = point

    def value_and_jacobian(self, uv):
        uv = uv.double()
        columns = torch.func.vmap(torch.func.jacrev(self.point))(uv)
        return torch.func.vmap(self.point)(uv), columns


def height(z):
    return Graph(lambda p: torch.stack([p[0], p[1], z(p[0])]))


def sheet(vertices, seam_pairs=()) -> Surface:
    i = (np.arange(N)[:, None] * (N + 1) + np.arange(N)).ravel()
    halves = [np.stack([i, i + N + 1, i + N + 2], 1), np.stack([i, i + N + 2, i + 1], 1)]
    origin = np.arange(len(UV))
    for first, copy in seam_pairs:
        origin[copy] = first
    return as_it_lies("sheet", vertices, np.concatenate(halves), UV, "square", origin=origin)


PLANE = sheet(np.column_stack([UV, np.zeros(len(UV))]))
STEP = 0.01 * np.sqrt(8)  # the way's length on it


def over_ways(turned_squared):
    """Mean of a function of both ends' u over the square's ways, by quadrature."""
    u, angle = np.meshgrid(
        (np.arange(20_000) + 0.5) / 10_000 - 1, (np.arange(90) + 0.5) * np.pi / 90, indexing="ij"
    )
    return turned_squared(u, np.clip(u + STEP * np.cos(angle), -1, 1)).mean()


def test_a_surface_that_bends_as_its_source_has_no_wrinkles():
    figures = normal_variation(PLANE, height(torch.zeros_like), samples=500)
    assert all(value == pytest.approx(0, abs=1e-6) for value in figures.values())


def test_a_tilt_is_no_wrinkle():
    figures = normal_variation(PLANE, height(lambda u: 0.7 * u), samples=500)
    assert all(value == pytest.approx(0, abs=1e-6) for value in figures.values())


@pytest.mark.parametrize("frequency", [3.0, 40.0])
def test_a_wave_on_a_plane_is_the_closed_form(frequency):
    a = 0.2 / frequency

    def normal(u):
        slope = a * frequency * np.cos(frequency * u)
        return np.stack([-slope, np.ones_like(u)]) / np.sqrt(1 + slope**2)

    expected = np.degrees(np.sqrt(over_ways(lambda p, q: ((normal(q) - normal(p)) ** 2).sum(0))))
    figures = normal_variation(PLANE, height(lambda u: a * torch.sin(frequency * u)))
    assert figures["normal_variation_error_degrees"] == pytest.approx(expected, rel=0.02)
    assert figures["normal_variation_excess_degrees"] == pytest.approx(expected, rel=0.02)


def test_creases_count_although_the_facets_between_them_are_flat():
    # slopes ±0.1 by turns, a crease at each multiple of 0.1
    def zigzag(u):
        return 0.1 * torch.abs(torch.remainder(u, 0.2) - 0.1)

    jump = 2 * 0.1 / np.sqrt(1 + 0.1**2)
    crossed = over_ways(lambda p, q: (np.floor(p / 0.1) != np.floor(q / 0.1)).astype(float))
    figures = normal_variation(PLANE, height(zigzag))
    expected = np.degrees(jump * np.sqrt(crossed))
    assert figures["normal_variation_error_degrees"] == pytest.approx(expected, rel=0.03)


def cap(p):
    radius = 2.0
    return torch.stack([p[0], p[1], torch.sqrt(radius**2 - p[0] ** 2 - p[1] ** 2)])


def test_a_sphere_is_smooth_against_its_own_mesh_and_bent_against_a_plane():
    vertices = torch.func.vmap(cap)(torch.from_numpy(UV)).numpy()
    own = sheet(vertices)
    figures = normal_variation(own, Graph(cap))
    # on a sphere of radius R the normal turns by the way's length over R
    bent = np.degrees(0.01 * own.bounding_box_diagonal / 2.0)
    # the mesh's own normals are one-sided along its rim
    assert figures["normal_variation_error_degrees"] < 0.1 * bent
    assert abs(figures["normal_variation_excess_degrees"]) < 0.02 * bent
    flat = normal_variation(own, height(torch.zeros_like))
    assert flat["normal_variation_error_degrees"] == pytest.approx(bent, rel=0.03)
    assert flat["normal_variation_excess_degrees"] == pytest.approx(-bent, rel=0.03)


def test_both_sides_of_a_cut_have_one_normal():
    """A tube cut open along u = ±1, whose mesh is smooth across the cut."""
    tube = np.column_stack([np.cos(np.pi * UV[:, 0]), UV[:, 1], -np.sin(np.pi * UV[:, 0])])
    rim = np.arange(N + 1)
    whole = sheet(tube, np.stack([rim, rim + N * (N + 1)], axis=1))

    def point(p):
        return torch.stack([torch.cos(torch.pi * p[0]), p[1], -torch.sin(torch.pi * p[0])])

    joined = normal_variation(whole, Graph(point))["normal_variation_error_degrees"]
    open_ = normal_variation(sheet(tube), Graph(point))["normal_variation_error_degrees"]
    assert joined < 0.9 * open_


@pytest.mark.parametrize("lost", [0.0, float("nan")])
def test_a_map_without_normals_is_the_worst(lost):
    figures = normal_variation(PLANE, Graph(lambda p: lost * torch.cat([p, p[:1]])), samples=500)
    assert all(value == pytest.approx(180) for value in figures.values())
