"""The rasteriser beside a test of every pixel in every triangle."""

import numpy as np

from nsm.results.render import covering


def test_each_pixel_whose_centre_lies_in_a_triangle_is_found():
    generator = np.random.default_rng(0)
    size = 24
    xy = generator.uniform(-10, 34, (90, 2))  # beyond the picture as well
    xy[:12] = generator.integers(0, size, (12, 2)) + 0.5  # corners and edges at pixels' centres
    faces = generator.integers(0, 90, (120, 3))
    faces[:20] = generator.integers(0, 12, (20, 3))
    faces[0] = [3, 3, 7]  # seen edge-on
    xy[89] = np.nan
    pixel, face, weights = covering(xy, faces, size)

    centres = np.stack(np.meshgrid(*[np.arange(size) + 0.5] * 2), axis=-1).reshape(-1, 2)
    found = np.zeros((len(faces), size * size), dtype=bool)
    found[face, pixel] = True
    assert found.sum() == len(pixel)
    for k, corners in enumerate(xy[faces]):
        matrix = np.vstack([corners.T, np.ones(3)])
        if not np.isfinite(corners).all() or abs(np.linalg.det(matrix)) < 1e-9:
            assert not found[k].any()
            continue
        places = np.column_stack([centres, np.ones(len(centres))])
        least = np.linalg.solve(matrix, places.T).min(axis=0)
        clear = np.abs(least) > 1e-9  # on an edge rounding decides
        assert np.array_equal(found[k][clear], least[clear] > 0)
    at = (weights[:, :, None] * xy[faces[face]]).sum(axis=1)
    assert np.allclose(at, centres[pixel])
    assert len(pixel) > 2000
