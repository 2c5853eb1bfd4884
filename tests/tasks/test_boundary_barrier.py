"""The barrier that keeps the image of a free boundary from meeting itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nsm.domains.planar_mesh import boundary_self_intersections
from nsm.surfaces.topology import boundary_loops
from nsm.tasks.boundary_barrier import BoundaryBarrier


class Moved(torch.nn.Module):
    """h that gives points their images, whatever the points are."""

    def __init__(self, image):
        super().__init__()
        self.image = torch.nn.Parameter(torch.as_tensor(image, dtype=torch.float64))

    def forward(self, uv):
        assert len(uv) == len(self.image)
        return self.image


# a quadrilateral of two triangles, one corner of which is drawn near to a side that is not its own
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def barrier_of(image, step=1):
    barrier = BoundaryBarrier(torch.as_tensor(SQUARE), FACES)
    loop = np.array([np.flatnonzero((p == SQUARE).all(axis=1))[0] for p in barrier.uv.numpy()])
    assert barrier(Moved(SQUARE[loop]), 0).item() == 0  # far apart
    h = Moved(np.asarray(image, dtype=float)[loop])
    return barrier, h, barrier(h, step)


def dented(d):
    """The square with a corner at a distance of the side opposite."""
    return [[0, 0], [1, 0], [0.5, d], [0, 1]]


@pytest.mark.parametrize("d", [0.02, 0.05, 0.1])
def test_it_is_that_of_the_source(d):
    # two sides meet the corner: only the side from (0, 0) to (1, 0) is not the corner's own
    image = np.array(dented(d))
    length = np.linalg.norm(np.roll(image, -1, axis=0) - image, axis=1)
    own = np.minimum(length, np.roll(length, 1))

    def term(k, side):
        a, b = image[side], image[(side + 1) % 4]
        t = np.clip((image[k] - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        reach = 0.25 * min(own[k], length[side])
        return max(0.0, reach / np.linalg.norm(image[k] - a - t * (b - a)) - 1) ** 2

    wanted = sum(
        term(k, side) for k in range(4) for side in range(4) if k not in (side, (side + 1) % 4)
    )
    assert barrier_of(dented(d))[2].item() == pytest.approx(wanted / 4, rel=1e-9)
    assert wanted > 0


def test_its_gradient_and_curvature_are_those_of_differences():
    barrier, h, value = barrier_of(dented(0.05))
    value.backward()
    at, gradient = h.image.detach().clone(), h.image.grad
    corner = int(gradient.norm(dim=1).argmax())
    step, values = 1e-5, []
    for move in (-step, 0.0, step):
        h.image.data = at.clone()
        h.image.data[corner, 1] += move
        values.append(barrier(h, 1).item())
    assert (values[2] - values[0]) / (2 * step) == pytest.approx(
        float(gradient[corner, 1]), rel=1e-6
    )
    h.image.data = at
    second = barrier.curvature(h, 1).hessians
    assert (values[0] - 2 * values[1] + values[2]) / step**2 == pytest.approx(
        float(second[corner, 1, 1]), rel=1e-4
    )
    assert torch.linalg.eigvalsh(second).min() >= 0


def test_a_crossing_within_a_step_costs_more_than_any_distortion():
    barrier, h, _ = barrier_of(dented(0.05))
    h.image.data[int((h.image[:, 1] == 0.05).int().argmax()), 1] = -0.05
    assert barrier(h, 1).item() > 1e4
    # where a step begins with it, it must be possible to undo it
    assert barrier(h, 2).item() < 1e4


def clasp():
    """A strip bent nearly to a ring, in the plane, and the first vertex of each of its ends."""
    angle, radius = np.meshgrid(np.linspace(0.15, 2 * np.pi - 0.15, 24), [0.8, 1.0])
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1).reshape(-1, 2)
    n = np.arange(23)
    quads = np.stack([n + 24, n + 25, n + 1, n], -1)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), (0, 23)


@pytest.mark.parametrize("weight", [0.0, 1e-3])
def test_what_is_pulled_across_the_boundary_stops_before_it(weight):
    vertices, faces, (first, last) = clasp()
    loop = boundary_loops(faces)[0]
    barrier = BoundaryBarrier(torch.as_tensor(vertices), torch.as_tensor(faces))
    assert np.array_equal(barrier.uv.numpy(), vertices[loop])
    h, start = Moved(vertices[loop]), torch.as_tensor(vertices[loop])
    ends = [int(np.flatnonzero(loop == k)[0]) for k in (first, last)]
    for step in range(20):
        optimizer = torch.optim.LBFGS([h.image], line_search_fn="strong_wolfe")

        def closure(step=step, optimizer=optimizer):
            optimizer.zero_grad()
            a, b = h.image[ends]
            # the ends want to change places
            pulled = ((a - start[ends[1]]) ** 2 + (b - start[ends[0]]) ** 2).sum()
            bent = 0.1 * (h.image.diff(dim=0) - start.diff(dim=0)).square().sum()
            loss = pulled + bent + weight * barrier(h, step)
            loss.backward()
            return loss

        optimizer.step(closure)
    crossings = boundary_self_intersections(h.image.detach().numpy(), np.arange(len(loop)))
    assert (crossings > 0) == (weight == 0)


def test_an_image_that_is_not_finite_has_no_finite_loss():
    barrier = barrier_of(dented(0.05))[0]
    assert barrier(Moved(SQUARE * np.nan), 1).isnan()
