"""The rasteriser beside a test of every pixel in every triangle, and shading beside its formula."""

import numpy as np

from nsm.results.rasteriser import covering, interpolated, rasterise
from nsm.results.render import View
from nsm.results.textures import GREY, checkerboard_at

SIZE = 24
CENTRES = np.stack(np.meshgrid(*[np.arange(SIZE) + 0.5] * 2), axis=-1).reshape(-1, 2)


def triangles():
    """Corners (90, 2) in a picture and beyond it, and faces (120, 3)."""
    generator = np.random.default_rng(0)
    xy = generator.uniform(-10, 34, (90, 2))  # beyond the picture as well
    xy[:12] = generator.integers(0, SIZE, (12, 2)) + 0.5  # corners and edges at pixels' centres
    faces = generator.integers(0, 90, (120, 3))
    faces[:20] = generator.integers(0, 12, (20, 3))
    faces[0] = [3, 3, 7]  # seen edge-on
    xy[89] = np.nan
    return xy, faces


def coordinates(corners):
    """Barycentric coordinates (S², 3) of the pixels' centres; None for triangles without area."""
    matrix = np.vstack([corners.T, np.ones(3)])
    if not np.isfinite(corners).all() or abs(np.linalg.det(matrix)) < 1e-9:
        return None
    return np.linalg.solve(matrix, np.column_stack([CENTRES, np.ones(len(CENTRES))]).T).T


def test_each_pixel_whose_centre_lies_in_a_triangle_is_found():
    xy, faces = triangles()
    pixel, face, weights = covering(xy, faces, SIZE)

    found = np.zeros((len(faces), SIZE * SIZE), dtype=bool)
    found[face, pixel] = True
    assert found.sum() == len(pixel)
    for k, corners in enumerate(xy[faces]):
        inside = coordinates(corners)
        if inside is None:
            assert not found[k].any()
            continue
        least = inside.min(axis=1)
        clear = np.abs(least) > 1e-9  # on an edge rounding decides
        assert np.array_equal(found[k][clear], least[clear] > 0)
    at = (weights[:, :, None] * xy[faces[face]]).sum(axis=1)
    assert np.allclose(at, CENTRES[pixel])
    assert len(pixel) > 2000
    assert np.array_equal(np.lexsort((pixel, face)), np.arange(len(pixel)))


def test_the_nearest_triangle_at_each_pixel_is_found():
    xy, faces = triangles()
    depth = np.random.default_rng(1).normal(size=len(xy))
    pixel, face, weights = rasterise(xy, depth, faces, SIZE)

    near = np.full((len(faces), SIZE * SIZE), -np.inf)
    doubtful = np.zeros(SIZE * SIZE, dtype=bool)
    for k, corners in enumerate(xy[faces]):
        inside = coordinates(corners)
        if inside is not None:
            least = inside.min(axis=1)
            doubtful |= np.abs(least) < 1e-9
            near[k, least > 0] = (inside @ depth[faces[k]])[least > 0]
    last, first = np.sort(near, axis=0)[-2:]
    doubtful |= first - last < 1e-9
    expected = np.where(first > -np.inf, near.argmax(axis=0), -1)
    shown = np.full(SIZE * SIZE, -1)
    shown[pixel] = face
    assert np.array_equal(shown[~doubtful], expected[~doubtful])
    assert (~doubtful).sum() > 400
    assert (np.diff(pixel) > 0).all()
    at = (weights[:, :, None] * xy[faces[face]]).sum(axis=1)
    assert np.allclose(at, CENTRES[pixel])


def test_of_several_triangles_at_one_depth_the_last_is_shown():
    xy, faces = triangles()
    twice = np.concatenate([faces, faces])
    face = rasterise(xy, np.zeros(len(xy)), twice, SIZE)[1]
    assert len(face) and (face >= len(faces)).all()
    last = rasterise(xy, np.zeros(len(xy)), faces, SIZE)
    pixel, every, _ = covering(xy, faces, SIZE)
    greatest = np.full(SIZE * SIZE, -1)
    np.maximum.at(greatest, pixel, every)
    assert np.array_equal(last[1], greatest[last[0]])


def test_any_layout_of_the_arrays_will_do():
    xy, faces = triangles()
    plain = rasterise(xy, xy[:, 0].copy(), faces, SIZE)
    columns = np.asfortranarray(xy)
    columns.flags.writeable = False
    other = rasterise(columns, columns[:, 0], np.asfortranarray(faces.astype(np.int32)), SIZE)
    assert all(np.array_equal(a, b) for a, b in zip(plain, other, strict=True))
    values = np.asfortranarray(np.arange(len(xy) * 2).reshape(-1, 2))
    corners, weights = faces[plain[1]], plain[2]
    expected = (weights[:, :, None] * values[corners]).sum(axis=1)
    assert np.allclose(interpolated(values, np.asfortranarray(corners), weights), expected)


def test_a_picture_without_triangles_is_white():
    white = View(np.eye(3), 8).draw(np.eye(3), np.zeros((0, 3), np.int64), lambda blend: 0.5)
    assert (white == 1).all()


def test_pixels_are_means_of_finer_ones_lit_by_their_normals():
    size = 8
    x, y = np.meshgrid([2, 5.5], [1, 7], indexing="ij")  # in pixels: half of the sixth column
    corners = np.column_stack([x.ravel(), y.ravel(), np.zeros(4)])
    reference = np.array([[-1, -1, 0], [1, 1, 0]]) / 1.06
    vertices = corners * [2 / size, -2 / size, 1] + [-1, 1, 0]
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    base = np.array([0.2, 0.5, 0.9])
    picture = View(reference, size, frame=np.eye(3)).draw(vertices, faces, lambda blend: base)

    light = np.array([-0.35, 0.55, 0.75]) / np.linalg.norm([-0.35, 0.55, 0.75])
    shine = 0.12 * min((light[2] + 1) / 1.87, 1) ** 24
    shown = base * (0.38 + 0.62 * light[2]) + shine
    expected = np.ones((size, size, 3))
    expected[1:7, 2:5] = shown
    expected[1:7, 5] = (shown + 1) / 2
    assert np.allclose(picture, expected)


def test_the_checkerboard_is_grey_where_there_is_no_point():
    uv = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    uv[::7, 0], uv[::5, 1], uv[3] = np.nan, np.inf, 1.0
    light, dark = np.array([[245, 243, 238], [52, 92, 140]]) / 255
    for (u, v), colour in zip(uv.tolist(), checkerboard_at(uv), strict=True):
        if not np.isfinite([u, v]).all():
            assert np.array_equal(colour, GREY)
            continue
        even = (int((u + 1) / 2 * 32) + int((v + 1) / 2 * 32)) % 2 == 0
        assert np.array_equal(colour, light if even else dark)
